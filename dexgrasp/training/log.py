"""Losses on disk: CSV for people and scripts, TensorBoard for eyes."""

import csv
from pathlib import Path


class Log:
    """metrics.csv (step, split, term, value) and TensorBoard events; rows past the resumed step are dropped."""

    def __init__(self, folder: Path, step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        path = folder / "metrics.csv"
        rows = list(csv.reader(path.open())) if path.is_file() else []
        kept = [row for row in rows[1:] if int(row[0]) <= step]
        self.file = path.open("w", newline="")
        self.csv = csv.writer(self.file)
        self.csv.writerows([["step", "split", "term", "value"], *kept])
        self.board = SummaryWriter(str(folder / "tensorboard"), purge_step=step)

    def write(self, step: int, split: str, terms: dict[str, float]) -> None:
        for name, value in {**terms, "total": sum(terms.values())}.items():
            self.csv.writerow([step, split, name, f"{value:.6g}"])
            self.board.add_scalar(f"{split}/{name}", value, step)
        self.file.flush()

    def close(self) -> None:
        self.file.close()
        self.board.close()
