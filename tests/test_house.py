"""Check that imports run one way through the rooms of gsbench, and that a module says in a sentence what it does."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tiny_run import ROOT

# The folders from the ground up. A module imports from its own folder and from lower floors, never from its neighbours.
FLOORS = (
    "process",
    "kernels",
    "scenes raster",
    "models measure",
    "train fetch",
    "gates",
    "report",
    "stability",
    "run",
    "launch view",
)
FLOOR = {folder: i for i, folders in enumerate(FLOORS) for folder in folders.split()}
LEAST_WORDS = 4
# Names that say nothing of what they name.
VAGUE = {"found", "one", "own", "said", "told", "seen", "theirs", "mine", "given", "made"}


def modules(root: Path) -> dict[str, ast.Module]:
    """Every module of a package by its dotted name, parsed."""
    parsed = {}
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root.parent).with_suffix("").parts
        parsed[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = ast.parse(path.read_text())
    return parsed


def imports(parsed: dict[str, ast.Module]) -> dict[str, set[str]]:
    """For each module those of the same package that it imports, in functions and for type checkers too. `from package
    import name` counts as an import of the module `package.name` where there is one."""
    graph: dict[str, set[str]] = {}
    for name, tree in parsed.items():
        imported: set[str] = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, f"{name}: expected absolute imports, got a relative one in line {node.lineno}"
                whole = [f"{node.module}.{alias.name}" for alias in node.names]
                imported |= {module if module in parsed else str(node.module) for module in whole}
        graph[name] = (imported & parsed.keys()) - {name}
    return graph


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import one another in turn, or an empty list."""
    done: set[str] = set()

    def visit(name: str, path: list[str]) -> list[str]:
        if name in path:
            return [*path[path.index(name) :], name]
        if name not in done:
            for imported in sorted(graph[name]):
                if cycle := visit(imported, [*path, name]):
                    return cycle
            done.add(name)
        return []

    return next((cycle for name in graph if (cycle := visit(name, []))), [])


def is_of_command(module: str, graph: dict[str, set[str]]) -> bool:
    """Whether a module is a command (`__main__`), or only commands import it."""
    importers = [name for name in graph if module in graph[name]] or [""]
    return module.endswith(".__main__") or all(name.endswith(".__main__") for name in importers)


def folder(module: str, graph: dict[str, set[str]]) -> str:
    """The folder of a module, or "" for a command and a loose file beside the folders."""
    first = [*module.split("."), ""][1]
    return first if first in FLOOR and not is_of_command(module, graph) else ""


def height(module: str, graph: dict[str, set[str]]) -> int:
    """The floor of a module in a graph without circles; a command is above all, a loose file as high as its imports."""
    if is_of_command(module, graph):
        return len(FLOORS)
    if room := folder(module, graph):
        return FLOOR[room]
    return max((height(imported, graph) for imported in graph[module]), default=-1)


def upward(graph: dict[str, set[str]]) -> list[str]:
    """The imports of a folder's modules that do not lead to the same folder or to a lower floor."""
    return [
        f"{name} imports {imported}"
        for name in graph
        for imported in graph[name]
        if (room := folder(name, graph))
        and room != folder(imported, graph)
        and height(imported, graph) >= height(name, graph)
    ]


def patched(tree: ast.Module) -> set[str]:
    """The names from other libraries whose attributes a module sets; Python's own belong to the process."""
    foreign = set()
    for node in ast.walk(tree):
        for alias in node.names if isinstance(node, ast.Import | ast.ImportFrom) else ():
            whole = str(node.module) if isinstance(node, ast.ImportFrom) else alias.name
            if whole.partition(".")[0] not in {"gsbench", *sys.stdlib_module_names}:
                foreign.add(alias.asname or alias.name.partition(".")[0])
    targets = [target for node in ast.walk(tree) if isinstance(node, ast.Assign) for target in node.targets]
    targets += [part for target in targets if isinstance(target, ast.Tuple) for part in target.elts]
    places = [ast.unparse(target).partition(".")[0] for target in targets if isinstance(target, ast.Attribute)]
    return foreign & set(places)


def is_sentence(line: str) -> bool:
    """Whether a first line has four words and ends in a full stop or a colon."""
    return line.endswith((".", ":")) and len(line.split()) >= LEAST_WORDS


def names_given(tree: ast.Module) -> Iterator[str]:
    """Every name that a module gives to a variable, an argument, an attribute, a function or a class."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()) | ast.arg(arg=name):
                yield name
            case ast.alias(asname=str(name)) | ast.ExceptHandler(name=str(name)) | ast.MatchAs(name=str(name)):
                yield name


def vague_names() -> list[str]:
    """Where a module of the project gives a name of VAGUE, with underscores before it or not."""
    tops = (ROOT / top for top in ("gsbench", "tests", "docs/site", "benchmarks", "tools", "examples"))
    return [
        f"{path.relative_to(ROOT)}: {name}"
        for top in tops
        for path in sorted(top.rglob("*.py"))
        for name in names_given(ast.parse(path.read_text()))
        if name.strip("_") in VAGUE
    ]


GSBENCH = modules(ROOT / "gsbench")


def test_imports_run_down():
    """Catches a kernel that needs a model, a report that needs a training, imports in a circle, and a new folder that
    no one has placed, whose modules would count as loose files."""
    assert {path.parent.name for path in (ROOT / "gsbench").glob("*/__init__.py")} == FLOOR.keys()
    graph = imports(GSBENCH)
    assert graph["gsbench.train.training_parts"] >= {"gsbench.config", "gsbench.models", "gsbench.scenes"}
    assert not circle(graph)
    assert not upward(graph)


def test_libraries_are_changed_in_known_places():
    """Catches a module that changes another library, which no file of this list names."""
    changed = {name: names for name, tree in GSBENCH.items() if (names := patched(tree))}
    assert changed == {"gsbench.view.request_guard": {"websockets_server"}}


@pytest.mark.parametrize("name", GSBENCH)
def test_a_module_says_what_it_does(name):
    """Catches a module whose first line is a heading or is missing."""
    first = (ast.get_docstring(GSBENCH[name]) or "").partition("\n")[0]
    assert is_sentence(first), f"{name}: expected a sentence as the first line, got '{first}'"


def test_no_name_is_vague():
    """Catches a variable, an argument, an attribute or a function whose name says nothing of what it is."""
    assert vague_names() == []


def test_the_checks_find_what_they_look_for():
    """Catches checks that pass whatever they are given."""
    parsed = {
        "g.raster": ast.parse("def f():\n    from g.models import a"),
        "g.models": ast.parse("import typing"),
        "g.models.a": ast.parse("from g import loose\nif TYPE_CHECKING:\n    import g.raster"),
        "g.loose": ast.parse("from g import errors, run"),
        "g.errors": ast.parse(""),
        "g.run": ast.parse("from g import errors, models"),
        "g.run.load": ast.parse("from g.run import __main__, a"),
        "g.run.__main__": ast.parse("from g import loose, view"),
        "g.view": ast.parse("from g import loose, run"),
    }
    graph = imports(parsed)
    assert graph["g.models.a"] == {"g.loose", "g.raster"}
    assert circle(graph) == ["g.raster", "g.models.a", "g.raster"]
    graph["g.models.a"].remove("g.raster")
    assert not circle(graph)
    assert sorted(upward(graph)) == [
        "g.models.a imports g.loose",  # which imports g.run
        "g.raster imports g.models.a",
        "g.run.load imports g.run.__main__",
    ]
    assert not is_sentence("Helpers of all kinds")
    assert not is_sentence("Small helpers.")
    names = names_given(
        ast.parse("def own(told, *, mine=1):\n    with a as found:\n        x.theirs: int = found.said")
    )
    assert sorted(set(names)) == ["found", "mine", "own", "theirs", "told"]
