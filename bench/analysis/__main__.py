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


def write(path: Path, content: str | bytes) -> None:
    """Writes a file; one that is cut off never has its name, and no link is followed."""
    path.parent.mkdir(exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    part.unlink(missing_ok=True)
    try:
        # "x" makes a new file only.
        with open(part, "xb") as file:
            file.write(content if isinstance(content, bytes) else content.encode())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def remove_earlier(folder: Path) -> None:
    """Removes the tables and figures of an earlier render, whose groups may have other names.
    Raises InputError for a link, which may lead to files of others."""
    made = {folder / "tables": (".csv", ".tex"), folder / "figures": (".svg", ".pdf")}
    for below in made:
        if below.is_symlink():
            way_out = "remove the link, or copy results.json to another folder"
            raise InputError(f"cannot write into `{below}`", "it is a symbolic link", way_out)
    for below, endings in made.items():
        for path in below.iterdir() if below.is_dir() else ():
            if path.suffix in endings and path.is_file() and not path.is_symlink():
                path.unlink()


def render(folder: Path, is_printing: bool) -> None:
    from files import markdown, table_files
    from page import to_html
    from report import make_report

    report = make_report(load_file(folder / FILE))
    remove_earlier(folder)
    text = markdown(report)
    write(folder / "results.md", text)
    for name, content in table_files(report):
        write(folder / "tables" / name, content)
    drawn: dict[str, dict[str, bytes]] = {}
    try:
        from figures import draw_all
    except ImportError as error:
        way_out = f"{install('matplotlib')}; then render again"
        print_error("warning", "there are tables and no figures", str(error), way_out)
    else:
        for slug, name, files in draw_all(report):
            for kind, picture in files.items():
                write(folder / "figures" / f"{name}.{kind}", picture)
            drawn.setdefault(slug, {})[name] = files["svg"]
    write(folder / "report.html", to_html(report, drawn))
    if is_printing:
        print(text, end="")


def run(arguments: argparse.Namespace) -> int:
    if arguments.command == "render":
        for folder in arguments.folders:
            render(folder, arguments.print)
        return 0
    from comparison import MIN_CHECKED, check_aa, compare

    if arguments.command == "compare":
        print(compare(load(arguments.a), load(arguments.b)), end="")
        return 0
    text, is_good = check_aa(load_file(arguments.file))
    print(text, end="")
    if not text:
        cause, way_out = f"no series has {MIN_CHECKED} values", "measure longer, without --quick"
        print_error("error", f"nothing to check in `{arguments.file}`", cause, way_out)
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
