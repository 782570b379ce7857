"""Files of a report: marks, escapes, and equal files of equal input."""

from __future__ import annotations

import csv
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from examples import HOSTILE, SIDES, group, results, rtt, series, store
from files import markdown, table_files
from page import to_html
from report import Report, make_report
from results import load_file
from styles import styles
from tables import number, to_csv

PROGRAM = Path(__file__).parent.parent


def report(folder: Path, content: dict[str, Any]) -> Report:
    return make_report(load_file(store(folder, content) / "results.json"))


def run(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-B", str(PROGRAM), *map(str, arguments)]
    all_of_it = {**os.environ, **environment}
    return subprocess.run(command, capture_output=True, text=True, env=all_of_it)


def test_numbers_have_three_digits() -> None:
    values = (0, 0.1, 1, 1.005, 12.345, 99.96, 123.4, 269744.3, 938564, 0.000123, -0.5, 1e-9)
    texts = "0 0.100 1.00 1.00 12.3 100 123 270000 938564 0.000123 -0.500 1.00e-09".split()
    assert [number(value) for value in values] == texts


def test_tables_have_statistics_costs_and_all_bases(tmp_path: Path) -> None:
    text = markdown(report(tmp_path, rtt(count=300)))
    assert "| rclpy | 300 (300 of 301) |" in text and "| energy per wake above idle, VDD_IN" in text
    bases = ("rclpy", "stand-in (Cyclone DDS for Python)", "bare reader")
    assert [text.count(f"Against {base}:") for base in bases] == [3, 2, 3]
    assert "so that p is too small" in text and "1 of 2 goals are met" in text
    assert "| wake, p50 | <= 20 µs | 18.5 µs | 18 to 19 | 2 | met |" in text
    assert "| lost samples | <= 0 | not measured | - | 1 | not met |" in text
    # Memory grows by 0.1 MB in 4 s.
    assert "| rclpy | +0.0250 | 0, 20 |" in text


def test_what_is_missing_is_a_dash(tmp_path: Path) -> None:
    text = markdown(report(tmp_path, rtt(count=300)))
    assert "| rclpy | 1 | 1.00 | 1.00 | 1.00 | - | - | - | 1.00 |" in text
    assert "| lambda, wasm | 0 | - | - | - | - | - | - | - |" in text
    lost = series("rclpy", [], reception={"sent": 9, "answered": 0})
    text = markdown(report(tmp_path, results(groups=[group("lost", ["rclpy"], lost)])))
    assert "| rclpy | 0 (0 of 9) | - |" in text and "Medians" not in text
    assert markdown(report(tmp_path, results())).startswith("# Gleaner bench: rtt\n\n## Machine")


def test_an_invalid_side_is_marked_and_not_compared(tmp_path: Path) -> None:
    one = report(tmp_path, rtt(count=300))
    text = markdown(one)
    assert "| lambda, wasm (invalid) | 300 (300 of 301) |" in text
    assert "lambda, wasm is invalid: turn 2: the processor was throttled 3 times." in text
    assert not any("lambda, wasm" in pair for pair in one.groups[1].differences)
    assert one.headline is not None and one.headline.rows[1][3] == "-"


def test_a_smoke_test_is_marked_in_every_row_and_meets_no_goal(tmp_path: Path) -> None:
    one = report(tmp_path, rtt(count=3, is_quick=True))
    text = markdown(one)
    rows = [line for line in text.splitlines() if re.match(r"\| (?!---)", line)]
    assert all(row.endswith(("| smoke test |", "| status |")) for row in rows)
    titles = re.findall(r"^(?:## )?(IMU.*in ms.*|Against.*|Medians.*)$", text, re.M)
    assert len(titles) > 5 and all("(smoke test)" in title for title in titles)
    assert not re.search(r"goal|\| (not )?met", text) and "< 0.001" not in text
    files = dict(table_files(one))
    assert not re.search("goal|20 ", files["all_measurements.tex"])
    assert '"wake, p50",µs,,,1,18.0,smoke test' in files["measurements.csv"]
    assert "too few values | too few values | too few values |" in text
    assert all(found.p is None and found.delta is None and found.interval is None
               for each in one.groups for found in each.differences.values())


class Texts(HTMLParser):
    """Texts of the cells of a page, and the names of all of its elements."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.cells: list[str] = []
        self.elements: set[str] = set()
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.add(tag)
        if tag in ("td", "h2"):
            self.cells.append("")

    def handle_data(self, data: str) -> None:
        if self.cells:
            self.cells[-1] += data


def test_results_that_are_not_complete_say_so(tmp_path: Path) -> None:
    one = report(tmp_path, {**rtt(count=30), "is_complete": False})
    text, page = markdown(one), to_html(one, {})
    assert text.startswith("# Gleaner bench: rtt (incomplete)\n\nThe measurement is not complete")
    assert page.count("(incomplete)</") == 2 and '<p class="mark">The measurement is not' in page
    assert "goals are met" not in text and "goals are met" not in page


def test_differences_have_the_ratio_of_each_turn(tmp_path: Path) -> None:
    sides = [series("rclpy", [1, 1, 2, 2, 4, 4], turns=[2, 2, 2]),
             series("wasm", [2, 2, 2, 2, 2, 2], turns=[2, 2, 2]), series("bare", range(1, 7))]
    one = report(tmp_path, results(groups=[group("g", ["rclpy"], *sides)]))
    text = markdown(one)
    assert "turns are drawn first, then blocks of up to 100 neighbours within them" in text
    assert "| 2.00, 1.00, 0.500 |\n| bare |" in text and "| ratio of each turn |" in text
    assert re.search(r"^\| bare \| 1.75 .* - \|$", text, re.M)
    rows = list(csv.DictReader(dict(table_files(one))["differences.csv"].splitlines()))
    assert [row["ratio_of_each_turn"] for row in rows] == ["2.0 1.0 0.5", ""]


def test_texts_are_neither_formulas_nor_control_codes(tmp_path: Path) -> None:
    names = ["=1+1", "+x", "-x", "@x", "\ta", "\rb", "\ud800c", "-"]
    sides = [series(name, [-1.0]) for name in names]
    content = results(bench="a\n|b <x>", notes=["one\ntwo <b> \x1b[0m"],
                      groups=[group("g", [], *sides)])
    content["machine"]["facts"]["board\n\udfff"] = "a|b\r\nc"
    one = report(tmp_path, content)
    rows = list(csv.DictReader(dict(table_files(one))["statistics.csv"].splitlines()))
    assert [row["side"] for row in rows] == ["'=1+1", "'+x", "'-x", "'@x", " a", " b", " c", "-"]
    assert to_csv(["a", "b"], [["\tx", -1.0], ["@x", "----"]]) == "a,b\n'\tx,-1.0\n'@x,----\n"
    assert {row["min"] for row in rows} == {"-1.0"}
    text = markdown(one)
    assert text.startswith("# Gleaner bench: a \\|b \\<x>\n")
    assert "\n- one two \\<b> [0m\n" in text and "\n- board : a\\|b c\n" in text
    text.encode()


def test_hostile_names_stay_texts(tmp_path: Path) -> None:
    sides = [series(HOSTILE, range(1, 9)), series("<script>\\$x$", range(2, 9))]
    content = results(groups=[group(HOSTILE, [HOSTILE], *sides)], notes=[HOSTILE])
    one = report(tmp_path, content)
    page = Texts(to_html(one, {}))
    assert HOSTILE in page.cells and "<script>\\$x$" in page.cells
    assert not page.elements & {"script", "x", "link", "iframe"}
    assert "| a\\|b \\<x> & _% | 8 |" in markdown(one)
    files = dict(table_files(one))
    latex = files["a-b-x.tex"]
    assert r"a\textbar{}b \textless{}x\textgreater{} \& \_\% & 8 & " in latex
    for tabular in re.findall(r"\\begin\{tabular\}\{(\w+)\}(.*?)\\end\{tabular\}", latex, re.S):
        rows = [line for line in tabular[1].splitlines() if line.endswith(r"\\")]
        assert {len(re.findall(r"(?<!\\)&", row)) + 1 for row in rows} == {len(tabular[0])}
    rows = list(csv.DictReader(files["statistics.csv"].splitlines()))
    assert [(row["group"], row["side"]) for row in rows] == [
        (HOSTILE, HOSTILE), (HOSTILE, "<script>\\$x$")
    ]
    assert float(rows[0]["median"]) == 4.5


def test_each_side_has_its_own_look_wherever_it_occurs() -> None:
    alone = {name: styles([name])[name] for name in SIDES}
    assert styles([*SIDES, HOSTILE, "wasm: a", "wasm: b"]).items() >= alone.items()
    for looks in (alone, styles(f"other {n}" for n in range(8))):
        assert len({(look.dashes, look.colour) for look in looks.values()}) == 8
    first = [alone[name] for name in ("lambda, wasm", "lambda, Python", "rclpy", "native Rust")]
    assert len({look.dashes for look in first}) == len({look.marker for look in first}) == 4


def test_equal_input_makes_equal_files(tmp_path: Path) -> None:
    content = rtt(count=120)
    content["groups"] = content["groups"][1:2] + content["groups"][3:]
    del content["groups"][0]["series"][3:]
    folders = [store(tmp_path / name, content) for name in "ab"]
    with ThreadPoolExecutor() as pool:
        both = pool.map(lambda one: run("render", "--print", one[1], PYTHONHASHSEED=one[0]),
                        zip("12", folders))
    for name, done in zip("ab", both):
        assert done.returncode == 0 and done.stderr == "", done.stderr
        assert done.stdout == (tmp_path / name / "results.md").read_text()
    files = {
        name: {path.relative_to(tmp_path / name): path.read_bytes()
               for path in sorted((tmp_path / name).rglob("*.*"))}
        for name in "ab"
    }
    assert files["a"] == files["b"]
    names = [str(path) for path in files["a"]]
    assert "report.html" in names and "figures/summary.pdf" in names
    assert "figures/few-values-ecdf.svg" in names and "tables/differences.csv" in names
    page = (tmp_path / "a" / "report.html").read_text()
    # Pictures are inside the page, which has scripts and addresses of none.
    assert page.count("data:image/svg+xml") == 7
    assert not re.search(r"<script|<link|src=\"(?!data:)|href=\"(?!#)|url\(", page)
    pdf = (tmp_path / "a" / "figures" / "summary.pdf").read_bytes()
    # 7 inches are 504 points.
    assert b"/MediaBox [ 0 0 504 " in pdf
    assert b"/CreationDate" not in pdf and b"/FontFile2" in pdf and b"/Type3" not in pdf


def test_a_render_replaces_the_files_of_an_earlier_one_and_follows_no_link(tmp_path: Path) -> None:
    sides = [series("\ud800", [1, 1e100]), series("rclpy", [-1e100, 2])]
    points = [{"name": "c", "points": [[-1e100, -1e100], [1e100, 1e100]]}]
    growths = [{"name": "w", "of": "s", "unit": "MB", "curves": points}]
    folder = store(tmp_path / "a", results(groups=[group("g", [], *sides)], growths=growths))
    outside = tmp_path / "outside"
    outside.write_text("kept")
    kept = ["tables/old.txt", "tables/link.csv", "figures/sub.pdf/x"]
    for name in ("tables/old.csv", "tables/old.tex", "figures/old.svg", "figures/old.pdf", *kept):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(outside) if "link" in name else (folder / name).touch()
    for name in ("results.md", "tables/costs.csv", "figures/w-curves.svg"):
        (folder / name).symlink_to(outside)
    done = run("render", folder)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert outside.read_text() == "kept" and (folder / "results.md").is_file()
    names = {str(path.relative_to(folder)) for path in folder.rglob("*")}
    assert names >= {*kept, "figures/w-curves.svg"}
    assert not any(re.search(r"old\.(csv|tex|svg|pdf)|part$", name) for name in names)
    links = {path.name for path in folder.rglob("*") if path.is_symlink()}
    assert links == {"link.csv"}
    (folder / "tables").rename(tmp_path / "tables")
    (folder / "tables").symlink_to(tmp_path / "tables")
    done = run("render", folder)
    assert done.returncode == 2 and "tables`" in done.stderr and "symbolic link" in done.stderr


@pytest.mark.parametrize("missing", ["numpy", "matplotlib"])
def test_a_missing_library_is_named_with_its_package(tmp_path: Path, missing: str) -> None:
    stub = tmp_path / "stubs" / missing
    stub.mkdir(parents=True)
    (stub / "__init__.py").write_text(f"raise ImportError('No module named {missing}')")
    folder = store(tmp_path / "run", rtt(count=9))
    done = run("render", folder, PYTHONPATH=str(stub.parent))
    assert f"apt install python3-{missing}" in done.stderr
    assert f"pip install {missing}" in done.stderr and "Traceback" not in done.stderr
    is_written = (folder / "report.html").is_file() and (folder / "tables/statistics.csv").is_file()
    assert (done.returncode, is_written) == ((1, False) if missing == "numpy" else (0, True))


def test_wrong_input_ends_with_exit_code_2(tmp_path: Path) -> None:
    for arguments in (["render", tmp_path], ["compare", tmp_path, tmp_path], ["draw"]):
        done = run(*arguments)
        assert done.returncode == 2 and "error: " in done.stderr, done
    assert "  cause: " in run("render", tmp_path).stderr
    done = run("check-aa", store(tmp_path, rtt(count=30)) / "results.json")
    assert done.returncode == 1 and "error: nothing to check in" in done.stderr
