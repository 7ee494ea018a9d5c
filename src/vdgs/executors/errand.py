"""A stage's work in pieces, brought to where a person wants it done: on this machine, on a Ray cluster or by SLURM."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from vdgs.errors import RunError, Stopped
from vdgs.executors.choosing import Machine, choose
from vdgs.executors.executor import Outcome
from vdgs.executors.fitness import Question
from vdgs.executors.kinds import Kind
from vdgs.executors.pieces import Piece, run_pieces
from vdgs.executors.placement import Share, Work
from vdgs.kernels import threads as threads_available
from vdgs.memory.process import available_bytes
from vdgs.runs.stage_folder import StageFolder
from vdgs.settings.executors import ExecutorOptions


@dataclass(frozen=True)
class Wish:
    """What a person asks of the place where pieces are done."""

    where: ExecutorOptions
    jobs: int = 0
    """Pieces at once; 0: as many as there is room for."""
    image_gb: float = 0.0
    """Memory for photographs; 0: by the memory that there is. On a cluster: of one piece."""
    device: str = "cpu"

    @property
    def sends(self) -> bool:
        """Whether work goes out even if one process could do it: to a cluster, or to several processes at once."""
        return self.where.executor != "local" or self.jobs > 1


@dataclass(frozen=True)
class Errand:
    """Work of a stage that is cut into pieces, of which some are left to do."""

    kind: Kind
    folder: Path
    """Where the folders of all pieces are."""
    total: int
    left: Sequence[int]
    piece: Callable[[int], StageFolder]
    command: Callable[[int, Share, str], list[str]]
    """What does a piece, with its share, on a device."""
    piece_bytes: int
    """Memory of the largest by estimate, beside its photographs."""
    question: Callable[[], Question]
    """What machines must see; asked of other machines only."""
    photographs_bytes: int = 0
    """What all photographs of a piece take at most, decoded; 0 where it keeps none."""

    def run(self, wish: Wish, console: Console, ready: Callable[[], None] = lambda: None) -> None:
        """Do what is left; `ready` is called once machines are known to be fit, before anything starts.

        Raises RunError if a piece failed (the others are done first), Stopped after Ctrl-C or SIGTERM (each saved), and
        VdgsError where a machine of a cluster cannot do the work, before anything starts.
        """
        kind = self.kind
        work = Work(len(self.left), self.piece_bytes, wish.jobs, wish.image_gb, kind, self.photographs_bytes)
        machine = Machine(threads_available(), available_bytes())
        with choose(wish.where, work, machine, self.question) as chosen:
            line = f"{len(self.left)} of {self.total} {kind.many} to {kind.work}, {chosen.line}"
            console.print(line, highlight=False)
            for note in chosen.notes:
                console.print(note, highlight=False)
            ready()
            share = chosen.share
            # A GPU that a piece is given is not this machine's.
            device = "auto" if share.needs.gpus and wish.device == "cpu" else wish.device
            pieces = [
                Piece(index, self.piece(index), self.command(index, share, device), share.needs, kind)
                for index in self.left
            ]
            outcomes = run_pieces(pieces, chosen.executor, console)
        self._raise_unless_done(outcomes)

    def _raise_unless_done(self, outcomes: Sequence[Outcome]) -> None:
        kind = self.kind
        if any(outcome.state == "stopped" for outcome in outcomes):
            raise Stopped(f"Stopped; every {kind.one} that was {kind.doing} is saved. The same command continues.")
        failed = [outcome for outcome in outcomes if outcome.state != "done"]
        if failed:
            raise RunError(
                f"{self.folder}: {len(failed)} of {self.total} {kind.many} failed:\n  "
                + "\n  ".join(f"{outcome.name}: {outcome.why}" for outcome in failed)
                + f"\nTheir output is in {self.folder}/NN/output.log. The same command tries them again."
            )
