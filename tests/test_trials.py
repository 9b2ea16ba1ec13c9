"""Tables of trials: written tables are read back, wrong ones refused with the line, the fault and a cure."""

from pathlib import Path

import pytest

from twin.errors import InputError
from twin.evaluation.statistics import wilson
from twin.evaluation.trials import (
    CELL_COLUMNS,
    EPISODE_COLUMNS,
    Cell,
    Trial,
    cells_csv,
    csv_text,
    read_real_trials,
    read_results,
    read_trials,
    tally,
    trials_so_far,
    write_real_trials,
)

TRIALS = [
    Trial("nerf", "straight", "sun", 0, "goal", 29.5, 300, 0.9),
    Trial("nerf", "straight", "sun", 1, "collision", 3.25, 40, None),
    Trial("runs/a, b", "straight", "sun:night:0.3", 0, "timeout", -0.1, 600, 0.0),
]
TWIN = [
    Cell("nerf", "straight", "sun", 100, 90),
    Cell("nerf", "straight", "held-out", 100, 80),
    Cell("simulator", "straight", "sun", 100, 20),
    Cell("simulator", "right_turn", "sun", 100, 10),
    Cell("simulator", "right_turn", "night", 100, 10),
    Cell("varied", "straight", "dawn+randomised", 100, 70),
]
HEADER = "policy,lighting,trials,successes\n"
DAYS = HEADER.replace("\n", ",twin_lighting\n")


def write(folder: Path, text: str) -> Path:
    path = folder / "results.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_trials_are_read_as_written(tmp_path: Path) -> None:
    path = write(tmp_path, csv_text(EPISODE_COLUMNS, (trial.row() for trial in TRIALS)))
    assert read_trials(path) == TRIALS
    assert tally(TRIALS) == [
        Cell("nerf", "straight", "sun", 2, 1),
        Cell("runs/a, b", "straight", "sun:night:0.3", 1, 0),
    ]


def test_a_results_table_with_spaces_after_its_commas_is_continued(tmp_path: Path) -> None:
    out = write(tmp_path, "policy, lighting, trials, successes, task, twin_lighting\nnerf, sun, 1, 1, straight, noon\n")
    write_real_trials(TRIALS[:2], tmp_path / "t.csv", out, "sun")
    assert out.read_text() == "policy,lighting,trials,successes,task,twin_lighting\nnerf,sun,2,1,straight,noon\n"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("nerf,sun,2,1,straight,sun\nnerf,sun,1,0,straight,sun\n", "line 3: nerf under sun is in .* line 2, too"),
        ("nerf,sun,2,2,straight,sun\n", "2 of them successes, but t.csv has 1 of 2; correct outcomes there"),
        ("nerf,sun,2,0,straight,sun\n", "0 of them successes, but t.csv has 1 of 2"),
    ],
)
def test_results_corrected_by_hand_are_not_overwritten(tmp_path: Path, rows: str, message: str) -> None:
    out, table = write(tmp_path, f"policy,lighting,trials,successes,task,twin_lighting\n{rows}"), tmp_path / "t.csv"
    table.write_text(csv_text(EPISODE_COLUMNS, (trial.row() for trial in TRIALS)))
    with pytest.raises(InputError, match=message):
        read_real_trials(table, out)


def test_a_table_written_half_is_continued(tmp_path: Path) -> None:
    """A kill between the two files leaves the results table one trial behind."""
    out = write(tmp_path, "policy,lighting,trials,successes,task,twin_lighting\nnerf,sun,0000000001,1,straight,sun\n")
    (tmp_path / "t.csv").write_text(csv_text(EPISODE_COLUMNS, (trial.row() for trial in TRIALS)))
    assert read_real_trials(tmp_path / "t.csv", out) == TRIALS


def test_cells_have_their_interval() -> None:
    header, row = cells_csv([TWIN[0]]).splitlines()
    assert header == ",".join(CELL_COLUMNS)
    low, high = wilson(90, 100)
    assert row == f"nerf,straight,sun,100,90,0.9000,{low:.4f},{high:.4f}"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("nerf,straight,sun,0,1,flew,1.0,5,", "line 3: cause = 'flew'; expected one of goal, collision"),
        ("nerf,straight,sun,0,1,collision,1.0,5,", "line 3: success = '1' with cause 'collision'"),
        ("nerf,straight,sun,-1,1,goal,1.0,5,", "line 3: seed = '-1'; expected a whole number"),
        ("nerf,straight,sun,0,1,goal,far,5,", "line 3: progress_m = 'far'; expected a number"),
        ("nerf,straight,sun,0,1,goal,nan,5,", "line 3: progress_m = 'nan'; expected a number"),
        ("nerf,straight,sun,0,1,goal,1.0,5", "line 3: 8 fields; expected 9"),
        ("nerf,straight,sun,7,1,goal,1.0,5,", "line 3: seed 7 of this policy, task and lighting is there twice"),
    ],
)
def test_an_invalid_row_is_named(tmp_path: Path, line: str, message: str) -> None:
    good = "nerf,straight,sun,7,1,goal,29.0,300,0.9"
    path = write(tmp_path, ",".join(EPISODE_COLUMNS) + f"\n{good}\n{line}\n")
    with pytest.raises(InputError) as error:
        read_trials(path)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_without_validated_trials_the_error_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="twin validate"):
        read_trials(tmp_path / "episodes.csv")
    header = write(tmp_path, ",".join(EPISODE_COLUMNS) + "\n")
    with pytest.raises(InputError, match="has a header and no rows; run twin validate again"):
        read_trials(header)
    assert trials_so_far(header) == trials_so_far(tmp_path / "episodes.csv") == []


def test_results_find_their_cell(tmp_path: Path) -> None:
    text = (
        "policy, lighting ,trials,successes,task,twin_lighting\nnerf,sun,10,9,,\n\nnerf, dusk ,20,5,straight,held-out\n"
    )
    first, second = read_results([write(tmp_path, "\ufeff" + text)], TWIN)
    assert (first.key, first.twin_key) == (("nerf", "straight", "sun"), ("nerf", "straight", "sun"))
    assert (second.key, second.twin_key) == (("nerf", "straight", "dusk"), ("nerf", "straight", "held-out"))
    assert (second.trials, second.successes, second.rate) == (20, 5, 0.25)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + "nerf,sun,10,11\n", "line 2: successes = 11 of 10 trials; expected at most 10"),
        (HEADER + "nerf,sun,-3,0\n", "line 2: trials = '-3'; expected a whole number, 0 or more"),
        (HEADER + "nerf,sun,10,-1\n", "line 2: successes = '-1'; expected a whole number"),
        (HEADER + "nerf,sun,10,5.5\n", "line 2: successes = '5.5'; expected a whole number"),
        (HEADER + "nerf,sun,ten,5\n", "line 2: trials = 'ten'; expected a whole number"),
        (HEADER + "nerf,sun,²,0\n", "line 2: trials = '²'; expected a whole number"),
        (HEADER + "nerf,sun,0,0\n", "line 2: trials = 0; expected at least 1"),
        (HEADER + "nerv,sun,10,5\n", "line 2: policy 'nerv' was not validated; did you mean 'nerf'?"),
        (
            HEADER + "other,sun,10,5\n",
            "line 2: policy 'other' was not validated; run twin validate with --policy other",
        ),
        (HEADER + "nerf,sunn,10,5\n", "line 2: lighting 'sunn' is not in the twin; did you mean 'sun'?"),
        (HEADER + "nerf,dusk,10,5\n", "expected one of held-out, sun; or add a column twin_lighting"),
        (
            DAYS + "nerf,dusk,10,5,sun\nvaried,dusk,10,5,dawn+randomised\n",
            "results.csv line 2; policies are compared under one lighting of the twin: give the same in all rows",
        ),
        (HEADER + "nerf,night,10,5\n", "policy 'nerf' was not validated under 'night'; run twin validate"),
        (HEADER + "simulator,sun,10,5\n", "was validated on straight and right_turn; add a column task"),
        (HEADER + "nerf,sun,10,5\nnerf,sun,10,6\n", "results.csv line 2, too; if these"),
        (HEADER + ",sun,10,5\n", "line 2: no policy; expected a name"),
        (HEADER + "nerf,sun,10\n", "line 2: 3 fields; expected 4"),
        (HEADER, "has a header and no rows"),
        ("", "is empty; its first line must be policy,lighting,trials,successes[,task][,twin_lighting]"),
        ("policy;lighting;trials;successes\n", "separated by ';', not by commas; expected policy,lighting"),
        ("policy\tlighting\ttrials\tsuccesses\n", "are separated by '\\t', not"),
        ("policy,lighting,trials,successes,\n", "column 5 has no name; delete it"),
        (HEADER + "nerf,sun,10,5\n" + HEADER, "line 3 repeats the header; delete it"),
        (HEADER + 'nerf,sun,10,5\nnerf,"sun,10,5\nnerf,sun,10,5\n', "line 3: 2 fields; expected 4"),
        (DAYS + "nerf,monday,10,5,sun\nnerf,Monday,10,5,sun\n", "results.csv line 2; use one spelling"),
        (HEADER + "varied,dawn,10,5\n", "lighting 'dawn' is not in the twin; did you mean 'dawn+randomised'?"),
        ("policy,lighting,trials\nnerf,sun,10\n", "no column successes"),
        ("policy,lighting,trials,successes,note\n", "unknown column 'note'"),
        (HEADER.replace("lighting", "policy,lighting"), "column 'policy' appears twice"),
        ("policy,lighting,trials,successes,task\nnerf,sun,10,5,strait\n", "not validated on task 'strait'; did you"),
        (HEADER + 'nerf,"sun\x00,10,5\n', "line 2"),
    ],
)
def test_wrong_results_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        read_results([write(tmp_path, text)], TWIN)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_several_tables_are_one_without_doubled_trials(tmp_path: Path) -> None:
    tables = [tmp_path / "monday.csv", tmp_path / "tuesday.csv"]
    for table, policy in zip(tables, ("nerf", "varied"), strict=True):
        table.write_text(f"{DAYS}{policy},{table.stem},10,5,{'sun' if policy == 'nerf' else 'dawn+randomised'}\n")
    assert [(cell.policy, cell.lighting) for cell in read_results(tables, TWIN)] == [
        ("nerf", "monday"),
        ("varied", "tuesday"),
    ]
    tables[1].write_text(tables[0].read_text())
    with pytest.raises(InputError, match=r"tuesday.csv line 2: .* is in .*monday.csv line 2, too; if these are other"):
        read_results(tables, TWIN)


@pytest.mark.parametrize("other", ["D\u0061\u0308mmerung 1", "dämmerung  1", "Dämmerung 1\u200b"])
def test_a_day_has_one_spelling(tmp_path: Path, other: str) -> None:
    rows = f"nerf,Dämmerung 1,10,9,sun\nsimulator,{other},10,9,sun\n"
    twin = [cell for cell in TWIN if cell.task == "straight"]
    with pytest.raises(InputError, match="use one spelling"):
        read_results([write(tmp_path, DAYS + rows)], twin)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_ends_of_lines_and_empty_lines_do_not_matter(tmp_path: Path, end: str) -> None:
    path = tmp_path / "results.csv"
    path.write_bytes(f"\n{HEADER}nerf,sun,10,9\n".replace("\n", end).encode())
    assert read_results([path], TWIN)[0].successes == 9


def test_lightings_of_the_twin_may_differ_in_case_alone(tmp_path: Path) -> None:
    twin = [Cell("nerf", "straight", name, 10, 5) for name in ("Day", "day")]
    rows = read_results([write(tmp_path, HEADER + "nerf,Day,10,5\nnerf,day,10,5\n")], twin)
    assert [row.lighting for row in rows] == ["Day", "day"]


def test_binary_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    path.write_bytes(b"policy,lighting\xff\xfe\n")
    with pytest.raises(InputError, match="no UTF-8"):
        read_results([path], TWIN)
    with pytest.raises(InputError, match="does not exist"):
        read_results([tmp_path / "none.csv"], TWIN)
