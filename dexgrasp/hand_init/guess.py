"""What was guessed, why, and how sure that is."""

from dataclasses import dataclass, field
from typing import Literal

Confidence = Literal["sure", "likely", "UNSURE"]


@dataclass(frozen=True)
class Guess:
    """One thing that the file does not say outright."""

    topic: str
    """What it is about: a key of the YAML (`palm`, `fingers.thumb`, `limits`, `meshes`, ...)."""
    text: str
    """What was taken, and why."""
    confidence: Confidence

    def __str__(self) -> str:
        return f"{self.confidence:6}  {self.topic}: {self.text}"


@dataclass
class Guesses:
    """All guesses of one hand, in the order in which they were made."""

    made: list[Guess] = field(default_factory=list)

    def add(self, topic: str, text: str, confidence: Confidence = "likely") -> None:
        """Note a guess; the same one is noted once."""
        guess = Guess(topic, text, confidence)
        if guess not in self.made:
            self.made.append(guess)

    def about(self, topic: str) -> list[Guess]:
        """Return the guesses about a topic."""
        return [guess for guess in self.made if guess.topic == topic]

    @property
    def unsure(self) -> list[Guess]:
        """Return those that somebody should look at."""
        return [guess for guess in self.made if guess.confidence == "UNSURE"]
