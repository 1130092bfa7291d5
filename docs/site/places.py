"""Draw places at random from the prose of gsbench, for a reader who has not seen the code to say which are clear.

    python docs/site/places.py [SEED] [FOLDER]

Half of the places are paragraphs of README.md and docs/, half are docstrings of gsbench/. The reader is asked of each:
understood at first reading, yes or no? CONTRIBUTING.md says what to do with the answers.
"""

import ast
import random
import re
import sys
from collections.abc import Iterator
from pathlib import Path

PLACES = 50
LEAST_WORDS = 6  # of a paragraph or docstring: a title is no sentence
MOST_WORDS = 90


def paragraphs(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield (file, paragraph) of README.md and docs/: no headings, tables, code or images."""
    for path in (folder / "README.md", *sorted((folder / "docs").glob("*.md"))):
        text = re.sub(r"^```.*?^```", "", path.read_text(), flags=re.DOTALL | re.MULTILINE)
        for block in re.split(r"\n\s*\n|\n(?=[-*] |\d+\. )", text):
            if not re.match(r"\s*(#|\||!|<|\$\$|```|\(\w+\)=)", block):
                yield path.relative_to(folder).as_posix(), block


def docstrings(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield (file and name, docstring) of the modules, classes and functions of gsbench/."""
    for path in sorted((folder / "gsbench").rglob("*.py")):
        name = path.relative_to(folder).as_posix()
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (text := ast.get_docstring(node)):
                yield f"{name}: {node.name}" if not isinstance(node, ast.Module) else name, text


def draw(folder: Path, seed: int) -> list[tuple[str, str]]:
    """Draw PLACES places, half from either kind; the same seed and files give the same places."""
    chance = random.Random(seed)
    drawn = []
    for kind in (paragraphs, docstrings):
        texts = [(where, " ".join(text.split())) for where, text in kind(folder)]
        fit = [text for text in texts if LEAST_WORDS <= len(text[1].split()) <= MOST_WORDS]
        drawn += chance.sample(fit, PLACES // 2)
    return drawn


if __name__ == "__main__":
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 0
    root = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).resolve().parents[2]
    for i, (place, passage) in enumerate(draw(root, number), 1):
        print(f"{i}. [{place}]\n   {passage}\n")
