"""Which room of the package may import which: downwards only, in no circle, and kernels through their door.

A room is a folder or a module right below `src/vdgs`. All imports count, those inside functions and those for type
checkers too: what a file names, it must be able to know. `experiments/` lies outside the package and above it: its
folders import every room, and of the package only the verb that hands over to it imports it.
"""

from __future__ import annotations

import ast
import graphlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

pytestmark = pytest.mark.xdist_group("layers")  # one worker reads all sources

ROOT = Path(__file__).parents[1]
PACKAGE, EXPERIMENTS = ROOT / "src" / "vdgs", ROOT / "experiments"

#: Lowest first. A room imports lower layers only: neither higher ones nor the other rooms of its own.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("errors",),
    ("config", "geometry"),
    ("system",),
    ("kernels",),
    ("visibility",),
    ("captures", "model"),
    ("partition", "synth"),
    ("runs",),
    ("distributed", "evaluation", "sfm", "training"),
    ("export", "rendering", "report"),
    ("pipeline", "viewer"),
    ("cli",),
    ("__main__", "ops"),
)
#: The folders of the experiments, lowest first, as the rooms of a package of its own.
EXPERIMENT_LAYERS: tuple[tuple[str, ...], ...] = (("baselines", "microbench"), ("bench",), ("reports",))
#: What other rooms may import of a room, beside the room itself.
DOORS: Mapping[str, tuple[str, ...]] = {
    "kernels": (
        "kernel_types",
        "constants",
        "gaussian_projection",
        "operations",
        "device_selection",
        "transfer",
        "idle_memory",
        "rotations",
        "spherical_harmonics",
    )
}
#: Who may look behind the doors: `doctor` says what the machine can do, `microbench` measures single kernels.
LOOKS_BEHIND = ("vdgs.cli.doctor", "experiments.microbench")
#: The stages, whose files import nothing from each other: what two stages need lies below both.
STAGES = tuple(
    f"vdgs.pipeline.{name}"
    for name in (
        "train_coarse", "find_motion", "count_visibility", "partition_stage", "train_block", "train_blocks",
        "merge_blocks", "evaluate_stage",
    )
)  # fmt: skip


@dataclass(frozen=True)
class Import:
    """One import of the package's own: modules by their full names."""

    where: str
    importer: str
    imported: str


def modules_of(package: Path) -> dict[str, Path]:
    """Every file of a package by its module's name."""
    found = {}
    for file in sorted(package.rglob("*.py")):
        parts = file.relative_to(package.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imports_of(package: Path, of: Path | None = None) -> list[Import]:
    """All imports inside the package, or of another one `of`, wherever in a file they stand."""
    of = of or package
    modules, found = modules_of(of), list[Import]()
    for name, file in modules_of(package).items():
        text = file.read_text(encoding="utf-8")
        if of is not package and of.name not in text:
            continue
        for node in statements_of(ast.parse(text, str(file))):
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                where = f"{file.relative_to(package.parent).as_posix()}:{node.lineno}"
                within = name if file.name == "__init__.py" else name.rpartition(".")[0]
                found += [Import(where, name, each) for each in _imported(node, within, modules, of.name)]
    return found


def statements_of(node: ast.AST) -> Iterator[ast.AST]:
    """All statements below a node: `ast.walk` visits the expressions too, which takes three times as long."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.stmt, ast.excepthandler, ast.match_case)):
            yield child
            yield from statements_of(child)


def _imported(node: ast.Import | ast.ImportFrom, within: str, modules: Iterable[str], package: str) -> list[str]:
    """The modules of the package that a statement in a file of the package `within` imports."""
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    else:
        base = node.module or ""
        if node.level:
            above = within.split(".")[: len(within.split(".")) - node.level + 1]
            base = ".".join([*above, *([node.module] if node.module else [])])
        names = [f"{base}.{alias.name}" if f"{base}.{alias.name}" in modules else base for alias in node.names]
    return list(dict.fromkeys(name for name in names if name.split(".")[0] == package))


def room_of(module: str) -> str:
    """`partition` for vdgs.partition.partition_scene; empty for the package itself, which only says its version."""
    return module.partition(".")[2].partition(".")[0]


def problems(package: Path, layers: tuple[tuple[str, ...], ...] = LAYERS) -> list[str]:
    """Everything that is wrong with the imports of a package, a sentence each."""
    imports = imports_of(package)
    return [
        *unlisted(package, layers), *upwards(imports, layers), *past_doors(imports), *between_stages(imports),
        *circles(imports),
    ]  # fmt: skip


def unlisted(package: Path, layers: tuple[tuple[str, ...], ...]) -> list[str]:
    """Rooms without a layer, and layers' rooms that are not there."""
    there = {room_of(module) for module in modules_of(package)} - {""}
    listed = [room for layer in layers for room in layer]
    return [
        *(f"{package.name}/{room}: belongs to no layer; add it to LAYERS" for room in sorted(there - {*listed})),
        *(f"LAYERS names {room}, which is not there" for room in sorted({*listed} - there)),
        *(f"LAYERS names {room} more than once" for room in sorted({*listed}) if listed.count(room) > 1),
    ]


def upwards(imports: Iterable[Import], layers: tuple[tuple[str, ...], ...]) -> list[str]:
    """Imports from a room into its own layer or a higher one."""
    height = {room: number for number, layer in enumerate(layers) for room in layer}

    def words(room: str) -> str:
        return f"{room} (layer {height[room] + 1}: {', '.join(layers[height[room]])})"

    found = []
    for each in imports:
        lower, upper = room_of(each.importer), room_of(each.imported)
        if lower == upper or not {lower, upper} <= height.keys():
            continue
        if height[upper] >= height[lower]:
            how = "of its own layer" if height[upper] == height[lower] else "above it"
            found.append(f"{each.where}: imports {each.imported}: {words(lower)} may not import {words(upper)}, {how}")
    return found


def past_doors(imports: Iterable[Import]) -> list[str]:
    """Imports of what a room keeps to itself."""
    found = []
    for each in imports:
        room, asking = room_of(each.imported), room_of(each.importer)
        inside = each.imported.split(".")[2:]
        if room in DOORS and asking != room and inside and inside[0] not in DOORS[room]:
            if each.importer.startswith(LOOKS_BEHIND):
                continue
            allowed = ", ".join([room, *(f"{room}.{name}" for name in DOORS[room])])
            found.append(f"{each.where}: imports {each.imported}: {asking} may import only {allowed}")
    return found


def between_stages(imports: Iterable[Import]) -> list[str]:
    """Imports between the files of two stages."""
    return [
        f"{each.where}: imports {each.imported}: stages do not import each other"
        for each in imports
        if each.importer in STAGES and each.imported in STAGES and each.importer != each.imported
    ]


def circles(imports: Iterable[Import]) -> list[str]:
    """A circle of files, and for every folder one of what lies in it: files and folders."""
    graphs: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for each in imports:
        graphs[""][each.importer].add(each.imported)
        source, target = each.importer.split("."), each.imported.split(".")
        shared = next(
            (i for i, (a, b) in enumerate(zip(source, target, strict=False)) if a != b), min(len(source), len(target))
        )
        if shared < min(len(source), len(target)):  # neither is the folder itself, that is its __init__
            folder = ".".join(source[:shared])
            graphs[folder][".".join(source[: shared + 1])].add(".".join(target[: shared + 1]))
    found = []
    for folder, graph in graphs.items():
        try:
            graphlib.TopologicalSorter(graph).prepare()
        except graphlib.CycleError as error:
            what = f"a circle in {folder}" if folder else "a circle of files"
            found.append(f"{what}: {' imports '.join(reversed(error.args[1]))}")
    return found


def test_every_room_has_its_layer():
    assert unlisted(PACKAGE, LAYERS) == []


@pytest.fixture(scope="module")
def imports() -> list[Import]:
    return imports_of(PACKAGE)


def test_rooms_import_downwards_in_no_circle_and_stages_nothing_of_each_other(imports):
    assert len(imports) > 500
    found = [*upwards(imports, LAYERS), *between_stages(imports), *circles(imports)]
    assert not found, "\n" + "\n".join(found)


def test_kernels_are_asked_at_their_door(imports):
    found = past_doors(imports)
    assert not found, "\n" + "\n".join(found)


def test_experiments_are_the_top_floor():
    assert unlisted(EXPERIMENTS, EXPERIMENT_LAYERS) == []
    found = [*upwards(inside := imports_of(EXPERIMENTS), EXPERIMENT_LAYERS), *circles(inside)]
    found += past_doors(used := imports_of(EXPERIMENTS, PACKAGE))
    assert not found, "\n" + "\n".join(found)
    assert len(used) > 100
    assert imports_of(PACKAGE, EXPERIMENTS) == []  # the verb `bench` loads them by name where they are


@pytest.fixture
def tree(tmp_path):
    """Writes a package of made-up files: module name -> source."""

    def write(files: Mapping[str, str]) -> Path:
        package = tmp_path / "vdgs"
        for name, source in files.items():
            file = package / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(source, encoding="utf-8")
        return package

    return write


SMALL = (("low", "side"), ("kernels",), ("pipeline",), ("cli", "high"))
CLEAN = {
    "__init__.py": "", "low.py": "from vdgs import __version__", "side.py": "import json",
    "kernels/__init__.py": "from vdgs.kernels import cpu", "kernels/cpu.py": "from vdgs.kernels.kernel_types import T",
    "kernels/kernel_types.py": "import vdgs.low", "pipeline/train_coarse.py": "from vdgs.kernels import work",
    "pipeline/merge_blocks.py": "from vdgs.kernels.kernel_types import T",
    "high.py": "from vdgs.pipeline import train_coarse", "cli/doctor/cards.py": "from vdgs.kernels import cpu",
}  # fmt: skip
DOOR = (
    "kernels, kernels.kernel_types, kernels.constants, kernels.gaussian_projection, kernels.operations, "
    "kernels.device_selection, kernels.transfer, kernels.idle_memory, kernels.rotations, kernels.spherical_harmonics"
)


def test_the_checker_is_content_with_a_clean_tree(tree):
    assert problems(tree(CLEAN), SMALL) == []


@pytest.mark.parametrize(
    ("name", "source", "said"),
    [
        pytest.param(
            "side.py", "def f():\n    from vdgs.high import g",
            ["vdgs/side.py:2: imports vdgs.high: side (layer 1: low, side) may not import high (layer 4: cli, high), "
             "above it"], id="upwards, inside a function",
        ),
        pytest.param(
            "low.py", "if TYPE_CHECKING:\n    import vdgs.side as other",
            ["vdgs/low.py:2: imports vdgs.side: low (layer 1: low, side) may not import side (layer 1: low, side), of "
             "its own layer"], id="sideways, for type checkers",
        ),
        pytest.param(
            "pipeline/train_coarse.py", "from .merge_blocks import go",
            ["vdgs/pipeline/train_coarse.py:1: imports vdgs.pipeline.merge_blocks: stages do not import each other"],
            id="between stages, relative",
        ),
        pytest.param(
            "high.py", "from vdgs.kernels import cpu as kernels",
            [f"vdgs/high.py:1: imports vdgs.kernels.cpu: high may import only {DOOR}"], id="past the door",
        ),
        pytest.param(
            "pipeline/merge_blocks.py", "from vdgs.kernels.cpu.extension import threads",
            [f"vdgs/pipeline/merge_blocks.py:1: imports vdgs.kernels.cpu.extension: pipeline may import only {DOOR}"],
            id="far past the door",
        ),
        pytest.param("attic/box.py", "", ["vdgs/attic: belongs to no layer; add it to LAYERS"], id="a new room"),
    ],
)  # fmt: skip
def test_the_checker_names_what_is_wrong(tree, name, source, said):
    assert problems(tree(CLEAN | {name: source}), SMALL) == said


def test_the_checker_misses_rooms_that_are_gone(tree):
    without = {name: source for name, source in CLEAN.items() if name != "side.py"}
    assert problems(tree(without), SMALL) == ["LAYERS names side, which is not there"]


def test_the_checker_sees_circles_of_files_and_of_folders(tree):
    files = {"high/a.py": "from vdgs.high.b import x", "high/b.py": "def f():\n    from vdgs.high import a"}
    package = tree({name: source for name, source in CLEAN.items() if name != "high.py"} | files)
    said = problems(package, SMALL)
    assert len(said) == 2
    assert {line.partition(":")[0] for line in said} == {"a circle of files", "a circle in vdgs.high"}
    assert all("vdgs.high.a imports vdgs.high.b" in line for line in said)
    tree(
        {
            "high/b.py": "", "high/a.py": "", "high/first/x.py": "from vdgs.high.second.x import f",
            "high/first/y.py": "", "high/second/x.py": "", "high/second/y.py": "import vdgs.high.first.y",
        }
    )  # fmt: skip
    (circle,) = problems(package, SMALL)
    assert circle.startswith("a circle in vdgs.high: ")
    assert "vdgs.high.first imports vdgs.high.second" in circle
