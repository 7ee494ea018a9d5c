"""Whatever a name holds, other programs read it back from the scripts and headers that we write."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest

import vdgs
from support.fake_slurm import directive_words, file_name
from vdgs.config.executor_options import SlurmOptions
from vdgs.distributed.executor import TaskResources
from vdgs.distributed.slurm_executor import make_batch_script
from vdgs.errors import VdgsError
from vdgs.system.console import escape_names
from vdgs.system.quoting import header_line, sbatch_directive, shell_line, shell_word, slurm_file_pattern, wkt_string

HOSTILE = (
    "plain", "two words", "it's", 'say "yes"', "100 %", "%a", "$HOME", "`id`", "$(id)", "Flüge/Äcker", "a;b|c&d", "#1",
    "x # y", "*", "~", "!1", "-rf", "tab\tin", "hetjob", "my packjob", "[red]", "(a)", "<b>", "back\\slash",
    "line\nbreak",
)  # fmt: skip
ON_ONE_LINE = [name for name in HOSTILE if "\n" not in name]


def said_by(shell: str, lines: list[str]) -> str:
    return subprocess.run([shell, "-c", "\n".join(lines)], capture_output=True, text=True, check=True).stdout


def test_a_shell_reads_names_back(tmp_path: Path) -> None:
    lines = [shell_line(["printf", "%s\\n", name, "end"]) for name in HOSTILE]
    for name, line in zip(HOSTILE, lines, strict=True):
        assert shlex.split(line) == ["printf", "%s\\n", name, "end"]
    assert said_by("bash", lines) == "".join(f"{name}\nend\n" for name in HOSTILE)
    files = [tmp_path / name for name in HOSTILE]
    for file in files:
        file.parent.mkdir(exist_ok=True)
        file.write_text(f"here is {file.name}\n")
    assert said_by("sh", [f"cat {shell_word(file)}" for file in files]) == "".join(f"here is {f.name}\n" for f in files)
    for line in (f"cat {shell_word(Path('-x'))}", shell_line(["cat", Path("-x")])):
        assert shlex.split(line) == ["cat", "./-x"]
    assert shlex.split(shell_word(Path("~x"))) == ["./~x"]  # else vdgs takes it for a home folder, in quotes too


def test_sbatch_reads_directives_back() -> None:
    for name in ON_ONE_LINE:
        line = sbatch_directive(f"--comment={name}")
        assert directive_words(line.removeprefix("#SBATCH ")) == [f"--comment={name}"]
        assert not re.search("(het|pack)job", line)  # sbatch blanks these words


@pytest.mark.parametrize("name", [each for each in ON_ONE_LINE if "\\" not in each])
def test_a_batch_script_holds_any_folder(name: str, tmp_path: Path) -> None:
    folder = tmp_path / name / "slurm" / "vdgs-a"
    options = SlurmOptions(sbatch_args=("--comment=my job", "--qos=long"))
    script = make_batch_script(folder, 2, TaskResources(1), options, 2)
    (tmp_path / "job.sh").write_text(script)
    subprocess.run(["bash", "-n", str(tmp_path / "job.sh")], check=True)
    words = [word for line in script.splitlines() if line.startswith("#SBATCH ") for word in directive_words(line[8:])]
    output = next(word.removeprefix("--output=") for word in words if word.startswith("--output="))
    assert file_name(output, 1) == str(folder / "1.out")
    assert {"--comment=my job", "--qos=long"} <= set(words)
    assert shlex.split(script.splitlines()[-1])[-1] == str(folder)


@pytest.mark.parametrize("name", ["back\\slash", "line\nbreak"])
def test_folders_that_slurm_cannot_name_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(VdgsError, match="SLURM"):
        make_batch_script(tmp_path / name / "vdgs-a", 2, TaskResources(1), SlurmOptions(), 2)
    with pytest.raises(VdgsError, match="backslash"):
        slurm_file_pattern(Path("a\\b"), "%a")


def test_headers_stay_one_line() -> None:
    for name in HOSTILE:
        line = header_line(name)
        assert line.isascii()
        assert line.splitlines() == [line]
        assert json.loads(f'"{line}"') == " ".join(name.split())
        assert re.fullmatch(r'"[^"\n]*"', wkt_string(name))


def test_a_console_prints_names_with_brackets() -> None:
    from rich.text import Text

    for name in ("run[north]", "run[2]", "[a/b]", "[#1]", "x [link=y]", "plain"):
        assert Text.from_markup(escape_names(f"[yellow]note[/] {name}: done")).plain == f"note {name}: done"


def test_commands_for_people_quote_what_they_name() -> None:
    """A law over the source: what stands behind `vdgs VERB` in a text goes through `shell_word`, or is its result."""
    root = Path(vdgs.__file__).parent
    bare = re.compile(r"\bvdgs [a-z][a-z-]+ \{(?!shell_word\()(\w+[^}]*)\}")
    named = {"run", "folders"}  # values that are quoted already
    found = [
        f"{file.name}: {match[0]}"
        for file in root.rglob("*.py")
        for match in bare.finditer(file.read_text(encoding="utf-8"))
        if match[1] not in named
    ]
    assert found == []
