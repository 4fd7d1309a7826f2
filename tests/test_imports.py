"""Rooms lie on five floors: imports point downwards only, and never run in a circle.

Imports are read from the source, also those inside functions; imports for type checkers do not count.
"""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

FLOORS = [
    (
        "lerobot_lansar.calvin",
        "lerobot_lansar.cameras",
        "lerobot_lansar.pictures",
        "lerobot_lansar.benchmark",
        "lerobot_lansar.command",
        "lerobot_lansar.datasets",
        "lerobot_lansar.jobs",
        "lerobot_lansar.paths",
    ),
    ("lerobot_lansar.clip", "lerobot_lansar.trained_options"),
    (
        "lerobot_lansar.desk",
        "lerobot_lansar.policy",
        "lerobot_lansar.act_depth",
        "lerobot_lansar.peers",
        "lerobot_lansar.report",
        "dataset_convert",
    ),
    ("lerobot_lansar.envs",),
    (
        "lerobot_lansar.attention",
        "lerobot_lansar.demos",
        "lerobot_lansar.evaluation",
        "lerobot_lansar.replay",
        "lerobot_lansar.cli",
        "lerobot_policy_lansar",
        "benchmarks",
        "scripts",
    ),
]
"""Five floors from the ground up. Rooms of one floor do not import each other, except on the ground and at the top."""


def modules():
    """Every module of ours by name, with its file."""
    folders = ("lerobot_lansar", "dataset_convert", "benchmarks", "scripts")
    files = [ROOT / "lerobot_policy_lansar.py", *(f for folder in folders for f in (ROOT / folder).rglob("*.py"))]
    return {".".join(f.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): f for f in files}


def imports(name, file, known):
    """Which of our modules a file imports, by name."""
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    tree = ast.parse(file.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "__name__ == '__main__'"):
            node.body = []
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            found |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return found & known - {name}


def floor_and_room(name):
    """The number of a module's floor and the room that it belongs to, or None."""
    for number, rooms in enumerate(FLOORS):
        for room in rooms:
            if name == room or name.startswith(room + "."):
                return number, room
    return None


def graph():
    """Every module of ours to those that it imports."""
    found = modules()
    return {name: imports(name, file, set(found)) for name, file in found.items()}


def test_every_module_has_a_floor():
    assert [name for name in graph() if name != "lerobot_lansar" and floor_and_room(name) is None] == []


def test_the_package_itself_imports_no_room():
    # It runs before any of them: whatever it imported, every room would load.
    assert graph()["lerobot_lansar"] == set()


def test_imports_point_downwards():
    wrong = []
    for name, used in graph().items():
        for other in used - {"lerobot_lansar"}:
            (floor, room), (below, other_room) = floor_and_room(name), floor_and_room(other)
            ground_or_top = floor == below and floor in (0, len(FLOORS) - 1)
            if room != other_room and not ground_or_top and below >= floor:
                wrong.append(f"{name} imports {other}")
    assert wrong == []


def test_imports_never_run_in_a_circle():
    # A module's own package does not count: `from . import name` imports a neighbour.
    known = {name: {o for o in used if not name.startswith(o + ".")} for name, used in graph().items()}
    assert len(list(TopologicalSorter(known).static_order())) > 60  # raises CycleError
