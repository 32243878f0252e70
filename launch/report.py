"""Write the report of a run, or compare runs, as one HTML file.

python launch/report.py RUN              writes RUN/report.html
python launch/report.py RUN RUN [...]    writes comparison.html and comparison.csv next to the runs
python launch/report.py SWEEP            compares all runs below a folder, such as a sweep's, and writes there
python launch/report.py --paper RUN      sets an evaluation on PartNet-Mobility beside what is published: RUN/paper.md
"""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

VARIANTS = ("mask", "no_mask", "no_mask_vpa")
"""The published networks, named here because reading them takes a second; a test holds them to published.json."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (2: an error that the user can fix)."""
    parser = argparse.ArgumentParser(description="Write the report of a run, or compare several runs.")
    parser.add_argument(
        "runs", metavar="FOLDER", nargs="+", type=Path, help="a run folder, or a folder with runs below it (a sweep's)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="HTML file to write (default: RUN/report.html, or comparison.html in the folder or next to the runs); "
        "a comparison's numbers go beside it as .csv",
    )
    parser.add_argument("--paper", action="store_true", help="set one run beside what is published, as Markdown")
    parser.add_argument(
        "--variant",
        default=VARIANTS[0],
        choices=VARIANTS,
        help=f"with --paper: the published network to compare with (default: {VARIANTS[0]})",
    )
    options = parser.parse_args(arguments)
    # Imported late: --help answers at once.
    from fb3d_rl.errors import exit_code

    return exit_code(lambda: run(options), interrupted="nothing was written")


def run(options: argparse.Namespace) -> None:
    """Read the runs, print and write."""
    from fb3d_rl.errors import UserError
    from fb3d_rl.evaluation import comparison, comparison_tables, published, runs, tables
    from fb3d_rl.files import write_text
    from fb3d_rl.report import comparison_page
    from fb3d_rl.report import run_page as report

    folders: list[Path] = options.runs
    if options.paper:
        if len(folders) != 1:
            raise UserError("--paper sets one run beside what is published; give one run folder")
        page = published.paper(runs.read_run(folders[0]), options.variant)
        path = options.out or folders[0] / "paper.md"
        write_text(path, page)
    elif len(folders) == 1 and runs.is_run(folders[0]):
        path = report.write_report(folders[0], options.out)
        tables.show(runs.read_run(folders[0]).summary)
    else:
        finished, unfinished = runs.find_runs(folders)
        found = comparison.compare([runs.read_run(run) for run in finished])
        resolved = [folder.resolve() for folder in folders]
        beside = resolved[0] if len(folders) == 1 else Path(os.path.commonpath([run.parent for run in resolved]))
        path = comparison_page.write_comparison(found, options.out or beside / "comparison.html", unfinished)
        comparison_tables.show(found)
        if unfinished:
            print(f"left out, not finished (no summary.json): {', '.join(map(str, unfinished))}")
    print(f"wrote {path}")


if __name__ == "__main__":
    interrupt.run(main)
