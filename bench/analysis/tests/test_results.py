"""Files of results: refusals, several runs, and comparisons of two results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Callable

import pytest

import comparison
from comparison import check_aa, compare
from examples import HOSTILE, group, results, rtt, series, store
from results import InputError, load, load_file


def changed(change: Callable[[dict[str, Any]], object]) -> str:
    content = rtt(count=5)
    change(content)
    return json.dumps(content)


REFUSED = {
    "missing file": (None, "No such file"),
    "truncated": (changed(lambda it: None)[:-5], "line 1 column"),
    "not an object": ("[]", "should be an object"),
    "format 1": (changed(lambda it: it.update(format=1)), "its format is 1; this program reads 2"),
    "format 3": (changed(lambda it: it.update(format=3)), "its format is 3; this program reads 2"),
    "missing key": (changed(lambda it: it["groups"][0].pop("bases")), "`groups[0].bases`"),
    "text": (changed(lambda it: it.update(bench=7)), "`bench` should be a text"),
    "flag": (changed(lambda it: it.update(is_quick=1)), "`is_quick` should be true or false"),
    "value": (
        changed(lambda it: it["groups"][0]["series"][1].update(values=[1.0, "2"])),
        "`groups[0].series[1].values[1]` should be a number",
    ),
    "true": (changed(lambda it: it["figures"][0].update(values=[True])), "should be a number"),
    "NaN": (changed(lambda it: it["figures"][0].update(values=[float("nan")])), "NaN"),
    "infinite": (changed(lambda it: 0).replace("18.0", "1e999"), "should be a finite number"),
    "huge": (changed(lambda it: 0).replace("18.0", "9" * 400), "should be a finite number"),
    "goal": (changed(lambda it: it["figures"][0].update(goal={"most": 1})), "one of `at_most`"),
    "point": (
        changed(lambda it: it["growths"][0]["curves"][0].update(points=[[1]])),
        "should be 2 numbers",
    ),
    "twice": (
        changed(lambda it: it["groups"][0].update(series=[series("a", [1]), series("a", [2])])),
        "different names",
    ),
    "deep": ("[" * 100_000, "recursion"),
    "list": (
        changed(lambda it: it["groups"][0]["series"][0].update(values=5)),
        "`groups[0].series[0].values` should be a list",
    ),
    "costs": (
        changed(lambda it: it["groups"][0]["series"][0].update(costs={"a": 5})),
        "`groups[0].series[0].costs.a` should be a list",
    ),
    "too large": (
        changed(lambda it: it["growths"][0]["curves"][0].update(points=[[-1e308, 1], [1e308, 1]])),
        "should be a finite number of at most 1e+100",
    ),
    "turns": (
        changed(lambda it: it["groups"][0]["series"][0].update(turns=[2, 2])),
        "the turns of `bare reader` add up to 4 of its 5 values",
    ),
    "negative turn": (
        changed(lambda it: it["groups"][0]["series"][0].update(turns=[6, -1])), "add up to 5",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_other_files_are_refused_with_their_name_and_the_reason(name: str, tmp_path: Path) -> None:
    text, cause = REFUSED[name]
    if text is not None:
        (tmp_path / "results.json").write_text(text)
    with pytest.raises(InputError) as refused:
        load_file(tmp_path / "results.json")
    assert "results.json" in str(refused.value) and cause in refused.value.cause


def one(shift: float, **more: Any) -> dict[str, Any]:
    rows = [{"name": "wake", "unit": "us", "goal": None, "values": [18.0, 19.0, 21.0]}]
    values = [1.5 + shift + n * 37 % 100 / 100 for n in range(200)]
    sides = [series("bare", [1 + n * 37 % 100 / 100 for n in range(200)]), series("wasm", values)]
    return results(figures=rows, groups=[group("IMU | 100 Hz", ["bare"], *sides)], **more)


def test_several_runs_have_the_median_of_each_run(tmp_path: Path) -> None:
    bad = one(9)
    bad["groups"][0]["series"][1]["invalid"] = ["throttled"]
    for name, run in (("002", one(0.5)), ("001", one(0)), ("003", bad)):
        store(tmp_path / name, run)
    both = load(tmp_path)
    assert both.figures[0].values == [19, 19, 19]
    bare, wasm = both.groups[0].series
    assert len(bare.values) == 3 and wasm.values == pytest.approx([1.995, 2.495])
    # One invalid run is left out; the others are valid.
    left_out = "left out: IMU | 100 Hz: wasm: run `003`: throttled"
    assert wasm.invalid == [] and both.notes == [left_out] and both.is_complete
    assert f"- B: {left_out}" in compare(load(tmp_path / "001"), both)
    assert load(tmp_path / "001") == load(tmp_path / "001" / "results.json")
    for name in ("001", "002"):
        store(tmp_path / name, {**bad, "is_complete": False})
    bad["machine"]["facts"] = {"kernel": "6.6", "processor": "AMD EPYC <x>", "board": "x"}
    store(tmp_path / "003", bad)
    both = load(tmp_path)
    assert both.groups[0].series[1].invalid == [f"run `00{n}`: throttled" for n in (1, 2, 3)]
    assert both.notes == ["the runs differ: kernel: 6.18.44, 6.6"] and not both.is_complete
    store(tmp_path / "004", one(0, is_quick=True))
    with pytest.raises(InputError, match="004"):
        load(tmp_path)


def test_each_row_of_two_results_has_an_effect_and_a_verdict(tmp_path: Path) -> None:
    other = one(0.5)
    other["machine"]["facts"]["kernel"] = "6.6"
    other["figures"].append({"name": "new", "unit": "s", "goal": None, "values": [1.0]})
    a, b = load(store(tmp_path / "a", one(0))), load(store(tmp_path / "b", other))
    text = compare(a, b)
    assert "| IMU \\| 100 Hz: bare | 1.50 ms | 1.50 ms | 1.00 |" in text
    assert "| no difference seen |" in text and "| higher by 25 % (" in text
    wake = next(line for line in text.splitlines() if "wake" in line)
    assert "19.0 µs" in wake and wake.endswith("| too few runs for a verdict |")
    assert "- only in one of them: new" in text
    assert "- the machines differ: kernel: 6.18.44, and 6.6" in text
    quick = compare(a, load(store(tmp_path / "c", one(0.5, is_quick=True))))
    assert "higher" not in quick and quick.count("| smoke test |") == 3


def test_rows_and_facts_of_one_side_are_not_lost(tmp_path: Path) -> None:
    def lost(value: float | None) -> dict[str, Any]:
        return {"name": "lost", "unit": "", "goal": {"at_most": 0.0}, "values": [value]}

    a, b = one(0), one(0, is_complete=False)
    a["figures"].append(lost(0.0))
    b["figures"] = [{**a["figures"][0], "values": [None]}, lost(5000.0)]
    a["groups"][0]["series"][0]["values"] = []
    b["machine"]["facts"]["board"] = "Orin"
    text = compare(load(store(tmp_path / "a", a)), load(store(tmp_path / "b", b)))
    for line in ("no values in B: wake", "no values in A: IMU | 100 Hz: bare", "B is not complete",
                 "lost: 0 in A, 5000 in B", "the machines differ: board: unknown, and Orin"):
        assert f"- {line}\n" in text
    assert text.count("no values") == 2 and "A is not" not in text


def test_an_invalid_series_is_not_compared(tmp_path: Path) -> None:
    bad = one(0.5)
    bad["groups"][0]["series"][1]["invalid"] = ["throttled"]
    text = compare(load(store(tmp_path / "a", one(0))), load(store(tmp_path / "b", bad)))
    assert "wasm |" not in text and "- invalid in B: IMU | 100 Hz: wasm: throttled" in text
    assert "no values" not in text


def test_a_series_does_not_differ_from_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparison, "SEEDS", 20)
    monkeypatch.setattr(comparison, "LEAST_EQUAL", 18)
    side = rtt(count=1000)["groups"][0]["series"][0]
    few = series(HOSTILE, [1.0] * 199)
    levels = [level + n * 37 % 100 / 100 for level in (1, 1, 3) for n in range(200)]
    sides = [side, few, series("levels", levels, turns=[200] * 3)]
    text, is_good = check_aa(load(store(tmp_path, results(groups=[group("g", [], *sides)]))))
    assert is_good and text.startswith("g: bare reader: no difference seen in ")
    assert text.count("\n") == 4
    # Turns that differ are stated, and are not an error.
    assert "g: levels: turn against turn: no difference seen in 1 of 3 pairs\n" in text
    assert "g: bare reader: turn against turn: no difference seen in 3 of 3 pairs\n" in text
    monkeypatch.setattr(comparison, "_is_equal", lambda turns, seed: seed > 2)
    text, is_good = check_aa(load(tmp_path))
    assert not is_good and "in 17 of 20, fewer than 18" in text
