"""The direction of imports (docs: architecture) and what the data workers may load."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "poem_jax"
FLOORS = {
    "cli": 10,
    "experiments": 9,
    "training": 8,
    "capture": 8,
    "tables": 8,
    "evaluation": 7,
    "weights": 7,
    "miniatures": 7,
    "mixture": 7,
    "viz": 6,
    "synthetic": 6,
    "models": 5,
    "data": 5,
    "fitting": 5,
    "losses": 5,
    "batch": 4,
    "hand": 4,
    "detection": 5,
    "calibration": 3,
    "render": 3,
    "geometry": 2,
    "io": 1,
    "typing": 0,
}
"""A room (folder or file of poem_jax/) imports only rooms on lower floors, and itself."""

WITHOUT_JAX = (
    "poem_jax",
    "poem_jax.batch",
    "poem_jax.data.augmentation",
    "poem_jax.data.batching",
    "poem_jax.data.frames",
    "poem_jax.data.pack",
    "poem_jax.data.sources.captures",
    "poem_jax.data.sources.dexycb",
    "poem_jax.data.sources.interhand",
    "poem_jax.data.sources.oakink",
    "poem_jax.data.sources.released_tars",
    "poem_jax.data.view_sampling",
    "poem_jax.geometry.cameras",
    "poem_jax.geometry.transforms",
    "poem_jax.hand",
    "poem_jax.hand.model",
    "poem_jax.io.meshes",
    "poem_jax.miniatures.names",
    "poem_jax.mixture.worker",
    "poem_jax.render.zbuffer",
    "poem_jax.synthetic.dataset",
)


def room_of(parts: tuple[str, ...]) -> str:
    """First part below poem_jax, without the ending of a file."""
    return parts[0].removesuffix(".py")


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(source: str, package: tuple[str, ...]) -> Iterator[str]:
    """Every module that a file imports, at any depth (functions, TYPE_CHECKING), relative ones resolved.

    `poem_jax.name` in an expression counts as well: the public surface imports the room behind the name.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            stem = ".".join((*base, *([node.module] if node.module else [])))
            yield stem
            yield from (f"{stem}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "poem_jax":
            yield f"poem_jax.{node.attr}"
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            yield from dynamic_import(node)


def dynamic_import(call: ast.Call) -> Iterator[str]:
    """The name of `importlib.import_module("...")`, where it is written out."""
    if call.args and isinstance(call.args[0], ast.Constant) and isinstance(call.args[0].value, str):
        yield call.args[0].value


def imports_of(path: Path) -> set[str]:
    package = path.relative_to(PACKAGE.parent).parent.parts
    names = set(imported_modules(path.read_text(encoding="utf-8"), package))
    return {name for name in names if name == "poem_jax" or name.startswith("poem_jax.")}


def files() -> list[Path]:
    return [path for path in sorted(PACKAGE.rglob("*.py")) if path != PACKAGE / "__init__.py"]


def test_every_room_has_a_floor() -> None:
    rooms = {room_of(path.relative_to(PACKAGE).parts) for path in files()}
    assert rooms <= set(FLOORS), f"give these rooms a floor, here and in the docs: {rooms - set(FLOORS)}"


@pytest.mark.parametrize("path", files(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_downwards(path: Path) -> None:
    room = room_of(path.relative_to(PACKAGE).parts)
    for name in imports_of(path) - {"poem_jax"}:
        target = name.split(".")[1]
        if target == room or target not in FLOORS:  # not a room: a name that poem_jax itself exports
            continue
        assert FLOORS[target] < FLOORS[room], (
            f"{path.relative_to(PACKAGE)} (floor {FLOORS[room]}) imports {name} (floor {FLOORS[target]}): "
            "a room stands above all that it imports"
        )


@pytest.mark.parametrize("path", files(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_rooms_import_each_other_by_their_own_names(path: Path) -> None:
    """`from poem_jax import apply` below the top floor would hide an arrow behind the public surface."""
    room = room_of(path.relative_to(PACKAGE).parts)
    names = {name.split(".")[1] for name in imports_of(path) - {"poem_jax"}} - {"__version__"}
    hidden = names - set(FLOORS)
    assert not hidden or FLOORS[room] == max(FLOORS.values()), f"import from the room itself: {hidden}"


def test_modules_do_not_import_in_circles() -> None:
    graph = {module_name(path): imports_of(path) for path in files()}
    edges = {name: sorted((targets & set(graph)) - {name}) for name, targets in graph.items()}
    assert find_circle(edges) is None


def find_circle(edges: dict[str, list[str]]) -> list[str] | None:
    """Return some path that comes back to its start, or None."""
    done: set[str] = set()

    def visit(name: str, trail: list[str]) -> list[str] | None:
        if name in trail:
            return [*trail[trail.index(name) :], name]
        if name in done:
            return None
        found = (visit(target, [*trail, name]) for target in edges[name])
        circle = next((c for c in found if c is not None), None)
        done.add(name)
        return circle

    return next((c for c in (visit(name, []) for name in sorted(edges)) if c is not None), None)


def test_the_walker_sees_every_kind_of_import() -> None:
    source = """
import poem_jax.io
from poem_jax.hand import model
from ..geometry import cameras
def later():
    from . import sibling
    import importlib
    importlib.import_module("poem_jax.training.loop")
    import poem_jax
    poem_jax.apply()
"""
    names = set(imported_modules(source, ("poem_jax", "models")))
    assert {
        "poem_jax.io",
        "poem_jax.hand",
        "poem_jax.hand.model",
        "poem_jax.geometry.cameras",
        "poem_jax.models.sibling",
        "poem_jax.training.loop",
        "poem_jax.apply",
    } <= names


def test_a_circle_is_found() -> None:
    assert find_circle({"a": ["b"], "b": ["c"], "c": []}) is None
    assert find_circle({"a": ["b"], "b": ["c"], "c": ["b"]}) == ["b", "c", "b"]


@pytest.mark.parametrize("module", WITHOUT_JAX)
def test_data_workers_do_not_load_jax(module: str) -> None:
    code = f"import sys, {module}; sys.exit(bool({{'jax', 'jaxlib', 'flax'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"importing {module} loads jax or fails\n{done.stderr}"
