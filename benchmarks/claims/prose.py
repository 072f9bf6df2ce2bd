"""Check of numbers quoted in prose: a page must contain each sentence registered in `sentences`, with the computed numbers.

The check fails if a page is edited without the record, or a record changes without the page. On the pages of `OTHER_NUMBERS`,
decimal fractions outside tables, code and generated sections that are in no registered sentence are also reported.
"""

import dataclasses
import re
from collections.abc import Iterator, Sequence

from benchmarks.ledger.records import CHECKOUT

_TESTS = ("p at most .05", "p is at most .05", "has p of at most .05", "cannot be less than .008")
OTHER_NUMBERS: dict[str, tuple[str, ...]] = {
    "docs/lab/ol_aux.md": ('"Steps to 0.5"', "(p < .05)", "keep 0.95", "decay of 0.95", "rank correlation of +1.0"),
    "docs/lab/indicator.md": ("(0.16 to 0.19)", "0.1 m"),
    "docs/lab/learner_options.md": ("0.16 to 0.19 of the goals", "with 0.1 the actor", "chance is 0.18"),
    "docs/lab/weightings_fast.md": ("from 0.5 to 0.07", "weights of 0.1", "0.1 is worse than OL-AUX-5"),
    "docs/lab/target_decay.md": (
        *("the old targets by 0.98", "Baselines' HER, which it builds on, is 0.95", "those of a decay of 0.95"),
        *("a decay of 0.9 is", "better than 0.95 on FetchReach", "0.8 on the finger is no better than 0.9"),
        *("their script says 0.98", "against 0.98 alone", "the hand at 0.9,"),
    ),
    "docs/auxiliary_losses.md": ("0.02 for auxiliary losses", "1.19 times as long as one with fixed weights"),
    "docs/indicator_rewards.md": ("p₁ = 0.8", "p₂ = 0.3", "p₁ = 0.45", '"Steps to 0.9"', "a success of at least 0.9 (20"),
    "docs/learner.md": ("with 0.1 the finger", "0.6 of the time", "near 0.5 with balancing and about 0.08 without"),
    "docs/algorithms.md": ("instead of 0.99",),
    "docs/weighting.md": (
        "costs 0.1 to 0.6 ms",
        "TorchJD 0.18.0",
        "JAX 0.10.2",
    ),
    "docs/claims.md": (),
    "docs/index.md": (),
    "docs/lab/results.md": (),
    "README.md": (),
}
"""Numbers in the sentences of each page that are not results of learning, but settings, formulas, speeds or task properties."""


@dataclasses.dataclass(frozen=True)
class Sentence:
    """Part of a sentence that quotes numbers or verdicts of a record.

    Attributes:
        page: Page below the root.
        quote: Text with the computed numbers.
        record: Name of the record that they come from, for messages.
        is_supported: True if the records support the text.
    """

    page: str
    quote: str
    record: str
    is_supported: bool = True


def plain(text: str) -> str:
    """Return the text without tables, code blocks and line breaks."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"\s+", " ", "\n".join(line for line in text.splitlines() if not line.startswith(("|", "    "))))


def differences(sentences: Sequence[Sentence]) -> Iterator[str]:
    """Yield sentences missing from their pages or unsupported by records, and decimal fractions in no registered sentence."""
    pages = {*OTHER_NUMBERS, *(sentence.page for sentence in sentences)}
    texts = {page: plain((CHECKOUT / page).read_text(encoding="utf-8")) for page in sorted(pages)}
    for sentence in sentences:
        if sentence.quote not in texts[sentence.page]:
            yield f"{sentence.page} does not say, as {sentence.record} does: {sentence.quote}"
        if not sentence.is_supported:
            yield f"{sentence.page}: {sentence.record} does not say: {sentence.quote}"
    for page in OTHER_NUMBERS:
        text = texts[page]
        quotes = [*(sentence.quote for sentence in sentences if sentence.page == page), *OTHER_NUMBERS[page], *_TESTS]
        for quote in sorted(quotes, key=len, reverse=True):
            text = text.replace(quote, " ")
        text = re.sub(r"<!-- [\w ]+: begin.*?: end -->", " ", text)  # written from records
        for match in re.finditer(r"(?<![\w.])[01]?\.\d+\b", re.sub(r"`[^`]*`", "", text)):
            around = match.string[max(match.start() - 30, 0) : match.end() + 30]
            yield f"{page}: no record is registered for {match[0]} in '...{around}...'"
