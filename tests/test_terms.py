"""README, docs, docstrings and what commands print use the field's words."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# What is no longer written, and what is written instead.
RETIRED = {
    r"\beven(?:ly)? (?:draws?|mix\w*)\b|\b(?:drawn|draws|come) evenly\b": "uniform sampling, "
    "domain randomization",
    r"\b(?:curricul\w+|schedule|sorted) by hand\b": "hand-designed",
    r"\bhand[-_ ]made\b|\bthe hand\b(?!-)": "hand-designed",
    r"\btold (?:the|a|no) target\b|\bnot told\b": "target-aware, target-free",
    r"\btold apart\b|\bnothing to be told\b": "no significant difference",
    r"\bpaid\b|\b(?:is|are|was|be) worth\b|\bworth to\b": "rewarded, reward",
    r"\bcop(?:y|ies) of (?:the|a|its) Solvers?\b": "replicas",
    r"(?<![\w/.{])lifetimes?\b(?![_=.}])": "student resets, runs",
    r"\b(?:three|several|first|last) lives\b|\b(?:one|its|every|a new) life\b": "student resets",
    r"\bwhat (?:came out|comes out|was tried)\b": "results; ablations and negative results",
    r"\bthe field's\b": "partially observable maze (MiniGrid-style); published",
    r"\bto the letter\b": "faithful, as published",
    r"\bof no account\b": "has no effect",
    r"\bwithout an end\b": "NaN or infinity",
    r"\bthe choice\b|\bunchosen\b|\+choose\b|\bchosen by default\b": "filtering, filtered",
    r"\ba look\b|\b(?:two|each|every|closer|one) looks?\b|\blooks? closely\b": "scoring pass",
    r"\btells? of\b": "return metrics, metrics",
    r"\binterval tells\b": "CI over student seeds, one teacher",
    r"\bgets? one line\b": "fails fast, listing the valid keys",
}


def pages() -> Iterator[tuple[str, str]]:
    """README and docs."""
    for file in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        yield str(file.relative_to(ROOT)), file.read_text(encoding="utf-8")


def package() -> Iterator[tuple[str, str]]:
    """Docstrings and string constants of the code, and comments of settings (``--help``)."""
    for folder in ("proposer_rl", "research", "examples"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            tree = ast.parse(file.read_text(encoding="utf-8"))
            docstrings = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
            for node in ast.walk(tree):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    text = node.value if node in docstrings else node.value.lstrip(". ")
                    yield f"{file.relative_to(ROOT)}:{node.lineno}", text
    for file in sorted([*(ROOT / "conf").rglob("*.yaml"), *(ROOT / "examples").rglob("*.yaml")]):
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
            yield f"{file.relative_to(ROOT)}:{number}", line.partition("#")[2].lstrip(". ")


def retired(text: str) -> Iterator[tuple[str, str]]:
    """Every retired term in a text, and its replacement."""
    for pattern, instead in RETIRED.items():
        for match in re.finditer(pattern, " ".join(text.split()), re.IGNORECASE):
            yield match[0], instead
    if re.match(r"\s*\.\.\. \w", text):
        yield text.strip()[:30], "a full sentence"


@pytest.mark.parametrize("texts", [pages, package], ids=lambda texts: texts.__name__)
def test_only_the_fields_words_are_used(texts) -> None:
    assert [(place, *hit) for place, text in texts() for hit in retired(text)] == []


def test_a_retired_term_is_found() -> None:
    found = [term for term, _ in retired("Draws? No, it was paid\nto the\nletter.")]
    assert found == ["paid", "to the letter"]
    assert list(retired("... and a half sentence")) and not list(retired("a full one ..."))
