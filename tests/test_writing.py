"""Wording of docstrings, comments and documents: the field's words, imperative first lines, short sentences, examples."""

import ast
import importlib
import inspect
import io
import pkgutil
import re
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = sorted(
    file for folder in ("swiftwrf", "augment", "tasks", "benchmarks", "tests") for file in (ROOT / folder).rglob("*.py")
)
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

FIRST_WORDS = "What|Of|The same|Whether|Where|Which|How|By|As|To"
SPEECH = "says?|said|tells?|told|hears?|heard|teach(?:es)?|taught"
PHRASES = (
    "so many|by how much|unless given|unless told|what is left|where it had been|theirs|anew|great-circle error|"
    "verdict|maker|the law|doubt|strengths|kernel ridge"
)
DENIED = re.compile(rf"\b(?:{SPEECH}|{PHRASES})\b", re.IGNORECASE)
MAX_WORDS, MAX_MEAN_WORDS = 40, 18


def _docstrings(file: Path) -> list[tuple[int, str]]:
    tree = ast.parse(file.read_text())
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    return [
        (getattr(node, "lineno", 1), text)
        for node in ast.walk(tree)
        if isinstance(node, kinds) and (text := ast.get_docstring(node))
    ]


def _docstring_sentences(text: str) -> list[str]:
    """Return the sentences of a docstring without its example; an argument and a list item begin a new one."""
    text = re.split(r"^\s*Example:", text, flags=re.MULTILINE)[0]
    text = re.sub(r"^\s*\|.*$|^\s*(?:Args|Returns|Raises|Attributes|Yields):$", "", text, flags=re.MULTILINE)
    text = re.sub(r"`[^`]*`", "Code", re.sub(r"^\s+[\w`, .*]+: |^\s*- ", "\n\n", text, flags=re.MULTILINE))
    blocks = (" ".join(block.split()) for block in re.split(r"\n\s*\n", text))
    return [part for block in blocks for part in re.split(r"(?<=[.!?:;])\s+", block)]


def _comments(file: Path) -> list[tuple[int, str]]:
    tokens = tokenize.generate_tokens(io.StringIO(file.read_text()).readline)
    return [(token.start[0], token.string) for token in tokens if token.type == tokenize.COMMENT]


def _sentences(text: str) -> list[str]:
    """Return the sentences of a Markdown text without code, tables and headings; a list item ends a sentence."""
    text = re.sub(r"```.*?```|<!--.*?-->|^---.*?^---", "", text, flags=re.DOTALL | re.MULTILINE)
    lines = [line for line in text.splitlines() if not re.match(r"\s*(?:\||#|!!!|!\[)", line)]
    text = re.sub(r"^\s*(?:[-*]|\d+\.)\s+", "\n\n", "\n".join(lines), flags=re.MULTILINE)
    text = re.sub(r"`[^`]*`", "code", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text))
    parts = (
        part
        for block in re.split(r"\n\s*\n", text)
        for part in re.split(r"(?<=[.!?:])\s+(?=[A-Z*\d`(])", " ".join(block.split()))
    )
    return [part for part in parts if len(part.split()) > 2]


def test_docstrings_and_comments_use_the_fields_words():
    first = re.compile(rf"(?:{FIRST_WORDS})\b")
    wrong = []
    for file in set(SOURCES) - {Path(__file__)}:  # which holds the list
        docstrings = _docstrings(file)
        found = [f"{line}: begins with {text.split()[0]!r}" for line, text in docstrings if first.match(text)]
        for line, text in docstrings + _comments(file):
            found += [f"{line}: {match[0]!r} in {' '.join(text.split())[:90]!r}" for match in DENIED.finditer(text)]
        for line, text in docstrings:
            found += [
                f"{line}: {words} words in {sentence[:90]!r}"
                for sentence in _docstring_sentences(text)
                if (words := len(sentence.split())) > MAX_WORDS
            ]
        wrong += [f"{file.relative_to(ROOT)}:{line}" for line in found]
    assert not wrong, "\n".join(wrong)


def test_documents_have_short_sentences_in_the_fields_words():
    wrong = []
    for file in DOCUMENTS:
        sentences = _sentences(file.read_text())
        counts = [len(sentence.split()) for sentence in sentences]
        found = [s for s, count in zip(sentences, counts, strict=True) if count > MAX_WORDS or DENIED.search(s)]
        if counts and sum(counts) / len(counts) > MAX_MEAN_WORDS:
            found.append(f"{sum(counts) / len(counts):.1f} words a sentence")
        wrong += [f"{file.relative_to(ROOT)}: {sentence}" for sentence in found]
    assert not wrong, "\n".join(wrong)


def _public() -> list[tuple[str, object]]:
    """Return what swiftwrf, augment and their packages export by __all__, with its first name."""
    found: dict[int, tuple[str, object]] = {}
    for top in ("swiftwrf", "augment"):
        package = importlib.import_module(top)
        packages = [top] + [f"{top}.{info.name}" for info in pkgutil.iter_modules(package.__path__) if info.ispkg]
        for name in packages:
            module = importlib.import_module(name)
            for export in getattr(module, "__all__", ()):
                value = getattr(module, export)
                if inspect.isclass(value) or inspect.isfunction(value):
                    found.setdefault(id(value), (f"{name}.{export}", value))
    return list(found.values())


def test_public_objects_have_an_example():
    assert [name for name, value in _public() if ">>>" not in (inspect.getdoc(value) or "")] == []
