"""A leaderboard as one HTML page that needs no other file, and as Markdown."""

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path

from dexgrasp.leaderboard.ranking import Ranking, draw_pareto, rankings
from dexgrasp.leaderboard.row import Interval, Row

WIDTH = 900
"""Pictures are made no wider, pixels."""
STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:1500px;margin:2rem auto;padding:0 1rem;color:#222}"
    "table{border-collapse:collapse;margin:1rem 0;font-variant-numeric:tabular-nums}"
    "td,th{border-bottom:1px solid #ddd;padding:.3rem .7rem;text-align:left;vertical-align:top}"
    "td:nth-child(n+4){white-space:nowrap}"
    "th{cursor:pointer;user-select:none;white-space:nowrap}th[aria-sort=ascending]::after{content:' \\25B2'}"
    "th[aria-sort=descending]::after{content:' \\25BC'}img{max-width:100%}code{font-size:.85em}"
    "pre{max-height:24rem;overflow:auto;background:#f6f6f6;padding:.6rem;font-size:12px}.note{color:#666}"
)
SCRIPT = """
for (const head of document.querySelectorAll('th')) head.onclick = () => {
  const table = head.closest('table'), column = [...head.parentNode.children].indexOf(head);
  const up = head.getAttribute('aria-sort') !== 'ascending';
  for (const other of head.parentNode.children) other.removeAttribute('aria-sort');
  head.setAttribute('aria-sort', up ? 'ascending' : 'descending');
  const key = row => row.children[column].dataset.key ?? row.children[column].textContent;
  const none = row => key(row) === '';
  const rows = [...table.tBodies[0].rows].sort((a, b) => {
    if (none(a) || none(b)) return none(a) - none(b);
    const x = Number(key(a)), y = Number(key(b));
    const order = Number.isNaN(x) || Number.isNaN(y) ? key(a).localeCompare(key(b)) : x - y;
    return up ? order : -order;
  });
  table.tBodies[0].append(...rows);
};
"""
HEAD = ("#", "run", "hand", "SR %", "CR %", "epsilon", "time s", "tried", "seed", "config", "data", "protocol")


def write_leaderboard(rows: Sequence[Row], folder: Path) -> tuple[Path, Path]:
    """Write leaderboard.html and leaderboard.md with its plots into `folder`; return both paths."""
    folder.mkdir(parents=True, exist_ok=True)
    lists = rankings(rows)
    plots = [draw_pareto(ranking, folder / f"pareto_{number}.png") for number, ranking in enumerate(lists, 1)]
    page, text = folder / "leaderboard.html", folder / "leaderboard.md"
    page.write_text(_page(lists, plots))
    text.write_text(_markdown(lists, plots))
    return page, text


def _told(entry: Interval | None, scale: float = 100.0, digits: int = 1) -> str:
    if entry is None or entry.value is None:
        return "-"
    value, low, high = (f"{scale * number:.{digits}f}" for number in (entry.value, entry.low, entry.high))
    return f"{value} [{low}, {high}]"


def _key(entry: Interval | None) -> str:
    return "" if entry is None or entry.value is None else repr(entry.value)


def _cells(ranking: Ranking, number: int, row: Row) -> list[tuple[str, str]]:
    """Return text and sorting key of each cell."""
    place = f"{number} =" if number > 1 and ranking.tied(row) else str(number)
    cells = [
        (place, str(number)),
        (row.title, row.title),
        (row.hand, row.hand),
        (_told(row.success), _key(row.success)),
        (_told(row.completion), _key(row.completion)),
        (_told(row.epsilon, 1.0, 3), _key(row.epsilon)),
        ("-" if row.seconds is None else f"{row.seconds:.3g}", "" if row.seconds is None else repr(row.seconds)),
        (str(row.success.trials), str(row.success.trials)),
        (str(row.seed), str(row.seed)),
        (row.config_hash, row.config_hash),
        (row.data, row.data),
        (f"{row.protocol} {row.rules}", row.protocol),
    ]
    return cells + [(row.label.get(key, ""), row.label.get(key, "")) for key in ranking.keys()]  # noqa: SIM118


def _headline(ranking: Ranking) -> str:
    return f"{ranking.protocol}, {ranking.kind}, data {ranking.data}"


def _note(lists: Sequence[Ranking]) -> str:
    count = sum(len(ranking.rows) for ranking in lists)
    return (
        f"{count} rows in {len(lists)} rankings. Only rows of the same protocol (all its values), the same data and "
        "the same number of attempts are ranked together. Brackets: 95 % intervals; = marks rows whose interval "
        "reaches that of the first. The config's hash leaves out the seed."
    )


def _markdown(lists: Sequence[Ranking], plots: Sequence[Path | None]) -> str:
    lines = ["# Leaderboard", "", _note(lists), ""]
    for ranking, plot in zip(lists, plots, strict=True):
        head = [*HEAD, *ranking.keys()]
        lines += [f"## {_headline(ranking)}", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
        for number, row in enumerate(ranking.rows, 1):
            cells = [text.replace("|", "\\|").replace("\n", " ") for text, _ in _cells(ranking, number, row)]
            lines.append(f"| {' | '.join(cells)} |")
        lines += ["", *([f"![Success rate against time]({plot.name})", ""] if plot else [])]
        lines += [f"{number}. {row.title}: `{row.folder}`" for number, row in enumerate(ranking.rows, 1)] + [""]
    return "\n".join(lines)


def _page(lists: Sequence[Ranking], plots: Sequence[Path | None]) -> str:
    parts = [f"<h1>Leaderboard</h1><p class='note'>{html.escape(_note(lists))} Click a head to sort.</p>"]
    for ranking, plot in zip(lists, plots, strict=True):
        head = "".join(f"<th>{html.escape(name)}</th>" for name in [*HEAD, *ranking.keys()])
        body = "".join(
            "<tr>" + "".join(_cell(*cell) for cell in _cells(ranking, number, row)) + "</tr>"
            for number, row in enumerate(ranking.rows, 1)
        )
        parts.append(f"<h2>{html.escape(_headline(ranking))}</h2>")
        parts.append(f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")
        if plot is not None:
            parts.append(_image(plot, "Success rate against time; the line joins what nothing beats in both"))
        parts += [_details(number, row) for number, row in enumerate(ranking.rows, 1)]
    return (
        "<!doctype html><html lang='en'><meta charset='utf-8'><title>Leaderboard</title>"
        f"<style>{STYLE}</style>{''.join(parts)}<script>{SCRIPT}</script></html>\n"
    )


def _cell(text: str, key: str) -> str:
    return f"<td data-key='{html.escape(key, quote=True)}'>{html.escape(text)}</td>"


def _details(number: int, row: Row) -> str:
    pictures = "".join(f"<h4>{html.escape(path.stem)}</h4>{_image(path, path.stem)}" for path in row.pictures)
    facts = f"{row.folder}, seed {row.seed}, data {row.data}, {row.protocol} {row.rules}, config {row.config_hash}"
    return (
        f"<details><summary>{number}. {html.escape(row.title)}</summary><p class='note'>{html.escape(facts)}</p>"
        f"{pictures}<pre>{html.escape(row.config or 'no config was found')}</pre></details>"
    )


def _image(path: Path, caption: str) -> str:
    """Return a picture as part of the page, made small."""
    from PIL import Image

    with Image.open(path) as image:
        small = image.convert("RGB")
        if small.width > WIDTH:
            small = small.resize((WIDTH, round(small.height * WIDTH / small.width)))
        buffer = io.BytesIO()
        small.save(buffer, "PNG", optimize=True)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f"<img alt='{html.escape(caption, quote=True)}' src='data:image/png;base64,{data}'>"
