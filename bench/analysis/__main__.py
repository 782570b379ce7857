"""Makes tables, figures and pages of results of benchmarks, and compares results."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from results import FILE, InputError, load, load_file

USAGE, FAILED = 2, 1


def print_error(kind: str, message: str, cause: str, way_out: str) -> None:
    print(f"{kind}: {message}\n  cause: {cause}\n  help:  {way_out}", file=sys.stderr)


def install(package: str) -> str:
    return f"sudo apt install python3-{package}, or: {sys.executable} -m pip install {package}"


def write(path: Path, text: str) -> None:
    """Writes a file; one that is cut off never has its name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    part.write_text(text, encoding="utf-8", newline="")
    os.replace(part, path)


def render(folder: Path, is_printing: bool) -> None:
    from files import markdown, table_files
    from page import to_html
    from report import make_report

    report = make_report(load_file(folder / FILE))
    text = markdown(report)
    write(folder / "results.md", text)
    for name, content in table_files(report):
        write(folder / "tables" / name, content)
    drawn: dict[str, list[str]] = {}
    try:
        from figures import draw_all
    except ImportError as error:
        way_out = f"{install('matplotlib')}; then render again"
        print_error("warning", "there are tables and no figures", str(error), way_out)
    else:
        drawn = draw_all(report, folder / "figures")
    write(folder / "report.html", to_html(report, folder / "figures", drawn))
    if is_printing:
        print(text, end="")


def run(arguments: argparse.Namespace) -> int:
    if arguments.command == "render":
        for folder in arguments.folders:
            render(folder, arguments.print)
        return 0
    from comparison import check_aa, compare

    if arguments.command == "compare":
        print(compare(load(arguments.a), load(arguments.b)), end="")
        return 0
    text, is_good = check_aa(load_file(arguments.file))
    print(text, end="")
    return 0 if is_good else FAILED


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="bench/analysis", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("render", help=f"write tables, figures and a page beside {FILE}")
    one.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    one.add_argument("--print", action="store_true", help="print the tables, too")
    one = commands.add_parser("compare", help="compare two results row by row")
    for name in ("a", "b"):
        one.add_argument(name, type=Path, metavar=name.upper(), help="file, folder, or all runs")
    one = commands.add_parser("check-aa", help="compare each series with itself")
    one.add_argument("file", type=Path, metavar="FILE")
    return parser.parse_args(arguments)


def main() -> int:
    try:
        return run(parse(sys.argv[1:]))
    except InputError as error:
        print_error("error", str(error), error.cause, error.way_out)
        return USAGE
    except ImportError as error:
        print_error("error", "cannot analyse results", str(error), install("numpy"))
        return FAILED
    except OSError as error:
        way_out = "check the space on the disk, and the permissions of the folder"
        print_error("error", f"cannot write `{error.filename}`", str(error.strerror), way_out)
        return FAILED


if __name__ == "__main__":
    sys.exit(main())
