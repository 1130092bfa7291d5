"""Check that imports run one way through the rooms of gsbench, and that a module says in a sentence what it does."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from tiny_run import ROOT

# From the ground up: a module imports from its own room and from rooms on lower floors, never from its neighbours.
FLOORS: tuple[set[str], ...] = (
    {"errors"},
    {"process"},
    {""},  # the package itself, which Python imports before any room but needs heap and threads of `process`
    {"config", "reading"},
    {"schedule"},
    {"kernels"},
    {"scenes"},
    {"raster"},
    {"models", "measure"},
    {"effects"},
    {"train", "report", "fetch"},
    {"run"},
    {"stability", "sweep", "view"},
    {"export"},
    {"__main__"},
)
LEAST_WORDS = 4


def modules(root: Path) -> dict[str, ast.Module]:
    """Every module of a package by its dotted name, parsed."""
    found = {}
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = ast.parse(path.read_text())
    return found


def executed(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes under `node`, less those that only a type checker reads."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        yield child
        yield from executed(child)


def imports(parsed: dict[str, ast.Module]) -> dict[str, set[str]]:
    """For each module those of the same package that it imports, in functions too.

    `from package import name` counts as an import of the module `package.name` where there is one.
    """
    graph: dict[str, set[str]] = {}
    for name, tree in parsed.items():
        found: set[str] = set()
        for node in executed(tree):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, f"{name}: expected absolute imports, got a relative one in line {node.lineno}"
                whole = [f"{node.module}.{alias.name}" for alias in node.names]
                found |= {one if one in parsed else str(node.module) for one in whole}
        graph[name] = (found & parsed.keys()) - {name}
    return graph


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import one another in turn, or an empty list."""
    done: set[str] = set()

    def visit(name: str, path: list[str]) -> list[str]:
        if name in path:
            return [*path[path.index(name) :], name]
        if name not in done:
            for imported in sorted(graph[name]):
                if found := visit(imported, [*path, name]):
                    return found
            done.add(name)
        return []

    return next((found for name in graph if (found := visit(name, []))), [])


def room(module: str) -> str:
    """The first part of a module's name below the package, which has none; a room's command stands above all rooms."""
    return "__main__" if module.endswith(".__main__") else [*module.split("."), ""][1]


def upward(graph: dict[str, set[str]]) -> list[str]:
    """The imports that do not lead to the same room or to a lower floor."""
    floor = {name: i for i, rooms in enumerate(FLOORS) for name in rooms}
    return [
        f"{name} imports {imported}"
        for name in graph
        for imported in graph[name]
        if room(name) != room(imported) and floor[room(imported)] >= floor[room(name)]
    ]


def is_sentence(line: str) -> bool:
    """Whether a first line has four words and ends in a full stop or a colon."""
    return line.endswith((".", ":")) and len(line.split()) >= LEAST_WORDS


GSBENCH = modules(ROOT / "gsbench")


def test_every_room_has_a_floor() -> None:
    """Catches a new room that no one has placed, which the next test could not judge."""
    assert {room(name) for name in GSBENCH} == set().union(*FLOORS)


def test_imports_run_down() -> None:
    """Catches a kernel that needs a model, a report that needs a training, and imports in a circle."""
    graph = imports(GSBENCH)
    assert graph["gsbench.train.loop"] >= {"gsbench.config", "gsbench.models", "gsbench.scenes"}
    assert not upward(graph)
    assert not circle(graph)


@pytest.mark.parametrize("name", GSBENCH)
def test_a_module_says_what_it_does(name: str) -> None:
    """Catches a module whose first line is a heading or is missing."""
    first = (ast.get_docstring(GSBENCH[name]) or "").partition("\n")[0]
    assert is_sentence(first), f"{name}: expected a sentence as the first line, got '{first}'"


def test_the_checks_find_what_they_look_for() -> None:
    """Catches checks that pass whatever they are given."""
    parsed = {
        "g.raster": ast.parse("def f():\n    from g.models import a"),
        "g.models": ast.parse("import typing"),
        "g.models.a": ast.parse("from g import raster\nif TYPE_CHECKING:\n    import g.run"),
        "g.run": ast.parse(""),
    }
    graph = imports(parsed)
    assert graph["g.models.a"] == {"g.raster"}
    assert circle(graph) == ["g.raster", "g.models.a", "g.raster"]
    assert upward(graph) == ["g.raster imports g.models.a"]
    assert not is_sentence("Helpers of all kinds")
    assert not is_sentence("Small helpers.")
