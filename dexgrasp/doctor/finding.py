"""What the doctor found: one thing, why it matters, how to mend it."""

from dataclasses import asdict, dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How bad it is."""

    ERROR = "error"
    """Grasps will be wrong, or something will refuse the hand."""
    WARNING = "warning"
    """Works, but probably not as meant."""
    NOTE = "note"
    """Good to know."""


@dataclass(frozen=True)
class Finding:
    """One thing that was seen."""

    severity: Severity
    subject: str
    """Link, joint, finger or file."""
    seen: str
    why: str
    mend: str

    def as_dict(self) -> dict[str, str]:
        """Return it for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        head = f"{self.severity.upper()}  {self.subject}: {self.seen}"
        return f"{head}\n    why   {self.why}\n    mend  {self.mend}"


def error(subject: str, seen: str, why: str, mend: str) -> Finding:
    """Return an error."""
    return Finding(Severity.ERROR, subject, seen, why, mend)


def warning(subject: str, seen: str, why: str, mend: str) -> Finding:
    """Return a warning."""
    return Finding(Severity.WARNING, subject, seen, why, mend)


def note(subject: str, seen: str, why: str, mend: str) -> Finding:
    """Return a note."""
    return Finding(Severity.NOTE, subject, seen, why, mend)
