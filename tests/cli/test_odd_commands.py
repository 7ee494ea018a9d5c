"""Commands that nobody means, from folders and with streams that nobody expects: one line says what is wrong."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from experiments.bench.cli import BenchArguments
from support.captures import tiny_scene, write_colmap
from support.commands import PATIENCE_SECONDS
from vdgs.cli.argument_parser import parse_words
from vdgs.cli.main import COMMANDS, main, verb_arguments
from vdgs.cli.run_cmd import RunArguments
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.options import Option, options_of
from vdgs.config.output_paths import is_output
from vdgs.config.presets import PRESETS
from vdgs.errors import VdgsError
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings

#: A process that does what stands in the braces, and writes a file, as commands do.
CODE = "import os, sys; from vdgs.system.exit_codes import exit_code_of; sys.exit(exit_code_of('vdgs', lambda: {}, ''))"


def path_options(outputs_only: bool = False) -> list[tuple[str, Option]]:
    """Every option and argument of every verb that names a file or folder."""
    return [
        (verb, option)
        for verb in COMMANDS
        for option in options_of(verb_arguments()[verb] or BenchArguments)
        if "Path" in str(option.hint) and (is_output(option.hint) or not outputs_only)
    ]


def command(verb: str, option: Option, word: str) -> list[str]:
    """A command line of a verb with a word for an option, and with what is required besides."""
    others = [each for each in options_of(verb_arguments()[verb] or BenchArguments) if each.is_required]
    words = [] if option.is_positional else [option.flag, word]
    for each in others:
        if each.is_positional:
            words = [word if each == option else "toy" if verb == "bench" else ".", *words]
        elif each != option:
            words += [each.flag, "somewhere"]
    return [verb, *words, *([word] if option.is_positional and not option.is_required else [])]


def process(code: str, shell: str = '"$@"', cwd: Path | None = None, **env: str) -> subprocess.CompletedProcess[bytes]:
    words = ["bash", "-c", shell, "bash", sys.executable, "-c", CODE.format(code)]
    return subprocess.run(
        words, capture_output=True, cwd=cwd, env=os.environ | env, timeout=PATIENCE_SECONDS, check=False
    )


@pytest.mark.parametrize("word", ["", "  "])
@pytest.mark.parametrize(("verb", "option"), path_options(), ids=lambda each: getattr(each, "flag", each))
def test_an_empty_path_is_not_the_folder_here(verb, option, word, tmp_path, monkeypatch, capsys):
    """`--output "$RUN"` of a variable that is not set."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(command(verb, option, word))
    assert ended.value.code == 2
    assert "needs a value" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("verb", "option"), path_options(), ids=lambda each: getattr(each, "flag", each))
def test_a_name_that_is_no_text_is_refused_by_every_verb(verb, option, tmp_path, monkeypatch, capsys):
    """OpenCV crashes on it, rasterio and safetensors raise."""
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text("vdgs:\n")
    with pytest.raises(SystemExit) as ended:
        main(command(verb, option, "\udcfc"))
    assert ended.value.code == 1
    assert "is no text in utf-8, so libraries cannot open it. Rename it." in capsys.readouterr().err


def test_a_photograph_whose_name_is_no_text_is_named(tmp_path, capsys):
    for name in ("a", "b", "c", "\udcfc"):
        (tmp_path / f"{name}.jpg").write_bytes(b"")
    with pytest.raises(SystemExit) as ended:
        main(["sfm", str(tmp_path), "--output", str(tmp_path.with_name("new")), "--dry-run"])
    assert ended.value.code == 1
    assert "\\udcfc.jpg: the name" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["below a file", "long", "loop"])
@pytest.mark.parametrize(
    ("verb", "option"), path_options(outputs_only=True), ids=lambda each: getattr(each, "flag", each)
)
def test_an_output_that_no_disk_can_hold_is_refused_at_once(verb, option, kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("kept")
    Path("loop").symlink_to("loop")
    (tmp_path / "config.yaml").write_text("vdgs:\n")
    word = {"below a file": "file/new.ply", "long": "a" * 300 + ".ply", "loop": "loop/new.ply"}[kind]
    with pytest.raises(SystemExit) as ended:
        main(command(verb, option, word))
    assert ended.value.code == 1
    assert f"{word}: cannot be written (" in capsys.readouterr().err
    assert Path("file").read_text() == "kept"


@pytest.mark.parametrize(("verb", "option"), path_options(), ids=lambda each: getattr(each, "flag", each))
def test_a_path_that_begins_with_a_tilde_is_in_the_home_folder(verb, option, tmp_path, monkeypatch, capsys):
    """Shells leave it as it is behind `--output=` and in quotes; a folder of this name would be made here."""
    home = tmp_path / "home"
    home.mkdir()
    (home / "file").touch()
    (tmp_path / "config.yaml").write_text("vdgs:\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(home))
    with pytest.raises(SystemExit) as ended:
        main(command(verb, option, "~/file/new.ply"))  # where none is, and none can be made
    assert ended.value.code == 1
    assert f"{home}/file/new.ply: " in capsys.readouterr().err
    assert not Path("~").exists()


def test_a_text_that_may_be_a_path_names_the_home_folder_too(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    given = parse_words(RunArguments, ["c", "--images=~/small", "--masks", "masks", "--output", "./~run"])
    assert given.get("options", "images") == "/home/me/small"
    assert given.get("options", "masks") == "masks"
    assert given.get("output") == Path("~run")
    assert parse_words(BenchArguments, ["toy", "--scenes", "~/place", "tiny"]).get("scenes") == (
        "/home/me/place", "tiny",
    )  # fmt: skip


@pytest.mark.parametrize("verb", ["run", "sfm", "inspect", "train-coarse"])
def test_a_run_is_neither_a_capture_nor_photographs(verb, tmp_path, capsys):
    """Its renders would become a scene."""
    renders = tmp_path / "run" / "evaluation" / "renders"
    renders.mkdir(parents=True)
    (tmp_path / "run" / "config.yaml").write_text("vdgs:\n  version: 1\n")
    (renders / "test_0001.png").write_bytes(b"")
    with pytest.raises(SystemExit) as ended:
        main([verb, str(tmp_path / "run"), "--output", str(tmp_path / "new")])
    assert ended.value.code == 1
    assert "run: is a run, neither a capture nor photographs" in capsys.readouterr().err


def test_a_project_is_needed_for_a_folder_of_its_photographs(tmp_path, capsys):
    """All photographs of the folder would be used, without a word."""
    (tmp_path / "DCIM").mkdir()
    with pytest.raises(SystemExit) as ended:
        main(["sfm", str(tmp_path / "DCIM"), "--images", "images_4", "--output", str(tmp_path / "new"), "--dry-run"])
    assert ended.value.code == 1
    assert "--images images_4: is for projects" in capsys.readouterr().err


def test_a_folder_inside_a_run_is_answered_with_the_run_and_others_with_none(tmp_path, capsys):
    for folder in ("run/coarse", "run/merged", "other", "merged"):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / "run" / "config.yaml").touch()
    for folder, said in (("run/merged", f"It lies in one: {tmp_path / 'run'}"), ("other", "Train first")):
        with pytest.raises(SystemExit):
            main(["eval", str(tmp_path / folder)])
        assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("target", ["link", "gone"])
@pytest.mark.parametrize("verb", ["status", "inspect"])
def test_a_link_that_leads_nowhere_is_called_so(verb, target, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("link").symlink_to(target)
    with pytest.raises(SystemExit) as ended:
        main([verb, "link", *(["--output", "new"] if verb == "inspect" else [])])
    assert ended.value.code == 1
    assert f"link: is a link to {target}, which leads to no file or folder" in capsys.readouterr().err


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_every_text_can_be_printed_in_every_encoding(encoding):
    done = process(r"print('20.1 \u2192 21.3 \u2191', 'no text: \udcfc')", PYTHONIOENCODING=encoding)
    assert (done.returncode, done.stderr) == (0, b"")
    assert rb"\udcfc" in done.stdout


def test_streams_that_are_closed_are_no_files(tmp_path):
    """The next file would get the number of standard error, and what libraries print."""
    done = process("os.open('made', os.O_CREAT | os.O_WRONLY) < 3", shell='"$@" <&- >&- 2>&-', cwd=tmp_path)
    assert done.returncode == 0
    assert (tmp_path / "made").is_file()


def test_a_folder_that_was_removed_is_named(tmp_path):
    done = process("0", shell='mkdir gone && cd gone && rmdir ../gone && "$@"', cwd=tmp_path)
    assert done.returncode == 1
    assert b"the current folder does not exist any more" in done.stderr


@pytest.mark.parametrize("buffered", ["", "1"])
@pytest.mark.parametrize("words", ["--help", "--version", "run --help"])
@pytest.mark.parametrize(("where", "says"), [("> /dev/full", b"No space left on device"), ("| true", b"")])
def test_output_that_nobody_can_take_is_no_traceback(words, where, says, buffered):
    line = f'"$0" -m vdgs {words} {where}; exit ${{PIPESTATUS[0]}}'
    env = os.environ | {"PYTHONUNBUFFERED": buffered}
    done = subprocess.run(
        ["bash", "-c", line, sys.executable], capture_output=True, env=env, timeout=PATIENCE_SECONDS, check=False
    )
    assert done.returncode in ((1,) if says else (0, 1))
    assert says in done.stderr
    assert b"Traceback" not in done.stderr
    assert b"Exception" not in done.stderr


def refuse_to_start(**_: object) -> None:
    pytest.fail("Ray is asked, and would try for minutes")


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1", "localhost:99999999", "no-host.invalid:6379"])
def test_a_cluster_that_does_not_answer_is_not_waited_for(address, monkeypatch):
    """Neither where a verb asks beforehand nor where one connects."""
    ray = pytest.importorskip("ray")
    from vdgs.distributed.ray_executor import check_reachable, connect

    monkeypatch.setattr(ray, "init", refuse_to_start)
    said = rf"^{address}: no Ray cluster that can be used.*ray status.*--address head:6379"
    with pytest.raises(VdgsError, match=said):
        check_reachable(address)
    with pytest.raises(VdgsError, match=said), connect(address):
        pytest.fail("is connected")


@pytest.mark.parametrize("answer", [b"", b"220 mail.example ESMTP ready\r\n"])
def test_what_listens_and_is_no_cluster_is_not_waited_for(answer, monkeypatch):
    ray = pytest.importorskip("ray")
    from vdgs.distributed import ray_executor

    monkeypatch.setattr(ray, "init", refuse_to_start)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"

        def serve() -> None:
            connection, _ = server.accept()
            connection.recv(len(ray_executor.HTTP2_PREFACE), socket.MSG_WAITALL)
            connection.sendall(answer)
            connection.close()

        thread = threading.Thread(target=serve)
        thread.start()
        with (
            pytest.raises(VdgsError, match=f"what listens at {address} is no Ray"),
            ray_executor.connect(address),
        ):
            pass
        thread.join()


def test_a_cluster_that_was_here_and_is_gone_is_not_waited_for(monkeypatch):
    """What `auto` means then stands in a file that outlives the cluster."""
    ray = pytest.importorskip("ray")
    from vdgs.distributed import ray_executor

    monkeypatch.setattr(ray, "init", refuse_to_start)
    monkeypatch.setattr(ray_executor, "_address_on_record", lambda: "127.0.0.1:1")
    with pytest.raises(VdgsError, match=r"^auto: no Ray cluster.*127\.0\.0\.1:1"), ray_executor.connect("auto"):
        pass


@pytest.mark.parametrize(
    ("verb", "more"),
    [("partition", []), ("train-blocks", []), ("eval", []), ("ortho", []), ("export", ["--output", "scene.ply"])],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_executor_that_is_not_there_is_refused_before_a_run_is_touched(verb, more, tmp_path, monkeypatch, capsys):
    """Nor is a lock left in folders that the work would have filled."""
    pytest.importorskip("ray")
    write_colmap(tmp_path / "C", tiny_scene())
    RunFolder(tmp_path / "run").create_or_check(RunSettings.create(tmp_path / "C", CaptureOptions(), PRESETS["laptop"]))
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")}
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main([verb, "run", *more, "--executor", "ray", "--address", "127.0.0.1:1"])
    assert "127.0.0.1:1: no Ray cluster that can be used" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")} == before


def test_a_ray_of_this_machine_that_does_not_start_is_told_in_words(monkeypatch):
    """Ray gives its node thirty seconds, and raises a bare Exception."""
    ray = pytest.importorskip("ray")
    from vdgs.distributed.ray_executor import connect

    def slow(**_: object) -> None:
        raise Exception("The current node timed out during startup.")

    monkeypatch.setattr(ray, "init", slow)
    with (
        pytest.raises(VdgsError, match=r"local: no Ray cluster.*The current node timed out"),
        connect("local"),
    ):
        pass


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run", ".", "\u2014output", "R"], "type --output"),
        (["run", ".", "\u2013\u2013output=R"], "type --output"),
        (["run", "-place", "--output", "R"], "write the path as ./-place"),
    ],
)
def test_dashes_of_texts_and_paths_are_explained(words, says, tmp_path, monkeypatch, capsys):
    (tmp_path / "-place").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("verb", "more"),
    [("run", []), ("run", ["--dry-run"]), ("train-coarse", [])],
    ids=["run", "dry run", "train-coarse"],
)
def test_a_folder_of_other_files_is_refused_before_anything_is_measured(verb, more, tmp_path, monkeypatch, capsys):
    write_colmap(tmp_path / "C", tiny_scene())
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("dear reader")

    def fail(*_: object, **__: object) -> None:
        raise AssertionError("measured first")

    for user in ("run_pipeline", "dry_run", "image_size"):
        monkeypatch.setattr(f"vdgs.pipeline.{user}.choose_image_size", fail)
    with pytest.raises(SystemExit) as ended:
        main([verb, str(tmp_path / "C"), "--output", str(tmp_path / "other"), *more])
    assert ended.value.code == 1
    assert "holds other files (letter.txt)" in capsys.readouterr().err


def test_a_terminal_without_width_is_printed_to(monkeypatch):
    monkeypatch.setenv("COLUMNS", "0")
    with pytest.raises(SystemExit):
        main(["status", "nowhere"])
    assert "COLUMNS" not in os.environ


def test_a_folder_that_is_too_long_for_sockets_is_refused_where_no_short_one_is(tmp_path, monkeypatch):
    from vdgs.distributed import ray_executor

    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path / ("long" * 30)))
    with ray_executor._socket_folder("local") as options:
        assert Path(options["_temp_dir"]).is_dir()
    monkeypatch.setattr(ray_executor, "SHORT_FOLDER", str(tmp_path / "none"))
    refused = ray_executor._socket_folder("local")
    with pytest.raises(VdgsError, match=r"is too long for the sockets of Ray.*Set RAY_TMPDIR to a folder"), refused:
        pytest.fail("Ray is started")
    with ray_executor._socket_folder("10.0.0.1:6379") as options:  # a cluster has its own
        assert options == {}
