"""Write the report of a run, or compare runs, as one HTML file.

python launch/report.py RUN              writes RUN/report.html
python launch/report.py RUN RUN [...]    writes comparison.html next to the runs
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (2: an error that the user can mend)."""
    parser = argparse.ArgumentParser(description="Write the report of a run, or compare several runs.")
    parser.add_argument("runs", metavar="RUN", nargs="+", type=Path, help="a run folder")
    parser.add_argument(
        "--out",
        type=Path,
        help="HTML file to write (default: RUN/report.html, or comparison.html next to the runs)",
    )
    options = parser.parse_args(arguments)
    # Imported late: --help answers at once.
    from fb3d_rl.contract import UserError
    from fb3d_rl.evaluation import report, tables

    try:
        if len(options.runs) == 1:
            path = report.write_report(options.runs[0], options.out)
            tables.show(report.read_run(options.runs[0]).summary)
        else:
            beside = Path(os.path.commonpath([run.resolve().parent for run in options.runs]))
            path = report.write_comparison(options.runs, options.out or beside / "comparison.html")
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
