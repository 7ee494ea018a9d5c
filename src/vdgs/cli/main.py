"""The command line: one verb per stage. No logic here; heavy imports wait until a verb runs."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from vdgs.system.exit_codes import exit_code_of

HELP = """\
usage: vdgs VERB [options]

vdgs turns a folder of drone photographs into one 3D Gaussian splatting scene.

  run CAPTURE --output RUN          everything: model, blocks, merge, metrics, report; the same command continues.
                                    CAPTURE may be a folder of photographs alone: `sfm` then comes first
  status RUN                        how far a run is, stage by stage, and what to type next
  view RUN                          move through the scene in a browser: layers, places, camera paths
  export RUN --output FILE          the scene for other programs: PLY, SPZ, SOG, glTF, 3D Tiles, LAZ
  doctor                            what this machine can use, and what to install for the rest

before a run:
  inspect CAPTURE --output FOLDER   what a capture holds and how well it covers the place
  config --output FILE              all settings as YAML with comments, for `run CAPTURE --config FILE`

the stages of a run, one by one:
  sfm PHOTOGRAPHS --output CAPTURE  photographs to a capture: poses, points, metres and north; the same command goes on
  train-coarse CAPTURE --output RUN train the global model; the same command continues it
  visibility RUN                    how many cameras see each part of the scene
  partition RUN                     cut the scene into blocks and give each its cameras
  train-blocks RUN [--block N]      train the blocks, or one of them; the same command continues
  merge RUN                         the blocks become one scene
  lod RUN                           levels of detail, for scenes of millions of anchors; the same command continues
  eval RUN                          metrics and pictures of the test views
  report RUN                        one HTML file with figures, metrics, pictures and settings

more:
  render RUN                        views or a camera path, as PNG or video
  ortho RUN                         orthophoto, surface model and visibility as GeoTIFFs
  synth OUTPUT                      generate a small aerial town with known truth
  bench TABLE --output FOLDER       methods x scenes x seeds: the paper's tables and a verdict; needs a checkout

vdgs VERB --help shows the options that people set, --help-all every one. A capture is a folder with images/ and
sparse/0 (COLMAP), transforms.json (nerfstudio), train/ and val/ (Mega-NeRF), the layout of MatrixCity, cams/
(MVSNet) or poses_bounds.npy (LLFF); `sfm` makes one of photographs.
"""

#: The verbs, which begin the lines of the help.
COMMANDS = tuple(re.findall(r"^  ([a-z][a-z-]*) ", HELP, re.MULTILINE))
#: Verbs that take up what they left when they were interrupted.
RESUMABLE_COMMANDS = ("run", "sfm", "train-coarse", "train-blocks", "lod", "ortho", "bench")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `vdgs`. Exit codes: 0 done, 1 an error that the message explains, 2 usage, 130 stopped; 3 from
    `vdgs status`, of a run that is not whole."""
    try:
        _answer(arguments)
    except KeyboardInterrupt:  # while modules were imported, before a verb began
        sys.exit(130)


def _answer(arguments: Sequence[str] | None) -> None:
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if not arguments or arguments[0] in ("-h", "--help", "--help-all", "help"):
        sys.exit(exit_code_of("vdgs", lambda: print(HELP, end="") or (0 if arguments else 2), ""))
    if arguments[0] in ("--version", "-v", "-V", "version"):
        from vdgs import __version__

        sys.exit(exit_code_of("vdgs", lambda: print(f"vdgs {__version__}"), ""))
    if arguments[0] not in COMMANDS:
        from vdgs.config.serialization import suggest

        meant = suggest(arguments[0].lower().lstrip("-"), [*COMMANDS, "help"])
        if verb := next((each for each in arguments[1:] if arguments[0].startswith("-") and each in COMMANDS), ""):
            meant = f"; the verb comes first: vdgs {verb} ..."
        elif arguments[0] in ("train", "process", "reconstruct"):
            meant = "; did you mean 'run'?"
        print(f"{HELP}\nvdgs: there is no verb {arguments[0]!r}{meant}", file=sys.stderr)
        sys.exit(2)
    sys.exit(_run_command(arguments[0], arguments[1:]))


def _run_command(command: str, arguments: list[str]) -> int:
    import logging
    import os

    from vdgs.cli.advice import MESSAGE_FIT, Advice
    from vdgs.system.native_messages import quiet_libraries

    # Before numpy, whose matrices here are thin: OpenBLAS would wake its threads for them, which wait by spinning.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # matplotlib warns of a home folder without write access, and then works without it.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    quiet_libraries()
    if os.environ.get("COLUMNS") == "0":  # no width is known; rich would print nothing
        del os.environ["COLUMNS"]
    kept = command in RESUMABLE_COMMANDS and "--dry-run" not in arguments
    again = "continues: what is finished is kept" if kept else "begins it anew"
    fit = Advice(command, verb_arguments).fit
    token = MESSAGE_FIT.set(fit)
    try:
        return exit_code_of(
            f"vdgs {command}", lambda: get_command(command)(arguments), f"The same command {again}.", fit
        )
    finally:
        MESSAGE_FIT.reset(token)


def get_command(name: str) -> Callable[[list[str]], Any]:
    """The function of a verb, which takes its arguments."""
    from vdgs.cli import capture_cmds, export_cmd, result_cmds, run_cmd, stage_cmds, tool_cmds

    function = f"{name.replace('-', '_')}_command"
    modules = (capture_cmds, export_cmd, result_cmds, run_cmd, stage_cmds, tool_cmds)
    return next(getattr(module, function) for module in modules if hasattr(module, function))


@cache
def verb_arguments() -> dict[str, type | None]:
    """The dataclass of the arguments of every verb; None of `bench`, which only a checkout has."""
    modules = {verb: sys.modules[get_command(verb).__module__] for verb in COMMANDS}
    return {
        verb: getattr(module, f"{verb.title().replace('-', '')}Arguments", None) for verb, module in modules.items()
    }


if __name__ == "__main__":
    main()
