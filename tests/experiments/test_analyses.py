"""Analyses of the reports: what they keep is taken for what it is."""

from pathlib import Path

from experiments.reports.analyses import paper_schedule


def test_rows_of_one_seed_are_not_printed_for_another(tmp_path, monkeypatch):
    commands, coarse = list[tuple[str, ...]](), list[Path]()

    def trained(run, folder, name, changes):
        coarse.append(run.path)
        return {"row": name, "made": len(coarse)}

    monkeypatch.setattr(paper_schedule, "call", lambda *given: commands.append(tuple(map(str, given))))
    monkeypatch.setattr(paper_schedule, "row_of", trained)
    wanted = dict(list(paper_schedule.CROSSED.items())[:1])
    first, second, again = (paper_schedule.main(tmp_path, tmp_path / "work", wanted, seed) for seed in (0, 1, 0))
    assert again == first
    assert [row["seed"] for row in first + second] == [0, 1]
    assert [row["made"] for row in first + second] == [1, 2]
    assert len(set(coarse)) == 2
    seeds = [given[given.index("--seed") + 1] for given in commands if given[0] == "train-coarse"]
    assert seeds == ["0", "1"]
