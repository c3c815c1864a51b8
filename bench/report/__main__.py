"""The report: runs what it shows, as far as that is not there, and writes one page.

    make report                 SIZE=small: minutes
    make report SIZE=paper      the paper's sizes: hours; goes on where it was stopped or killed
    make report-page SIZE=paper the page of what is there; runs nothing
    make report-docs SIZE=paper that, and docs/report.md with its pictures
    python3 bench/report SIZE [--page | --runs] [--docs] [--only PREFIX]... [--jobs N] [--folder DIR]
"""
import argparse
import pathlib
import sys
import time

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))

import cases  # noqa: E402
import cook  # noqa: E402
import dam_break  # noqa: E402
import footing  # noqa: E402
import hard_cases  # noqa: E402
import landslide  # noqa: E402
import page  # noqa: E402
import recordings  # noqa: E402
import runs  # noqa: E402
import work_precision  # noqa: E402

# A part is a module with TITLE, cases(size) and sections(shelf); README.md here says how to add one.
PARTS = (cook, footing, dam_break, landslide, work_precision, hard_cases)


def draw(size, folder, docs):
    """Writes the page of what is there, and docs/report.md if `docs`; gives the path of the last."""
    everything = [c for part in PARTS for c in part.cases(size)]
    shelf = recordings.Shelf(everything, folder / "runs", size)
    parts = [(part.TITLE, part.sections(shelf)) for part in PARTS]
    path = page.write(parts, shelf, folder, size)
    return page.write_docs(parts, shelf, folder, size, runs.ROOT / "docs") if docs else path


def main():
    parser = argparse.ArgumentParser(prog="bench/report", description="what the report shows, run and drawn")
    parser.add_argument("size", nargs="?", default="small", choices=cases.SIZES)
    parser.add_argument("--page", action="store_true", help="run nothing, draw what is there")
    parser.add_argument("--runs", action="store_true", help="draw nothing")
    parser.add_argument("--docs", action="store_true", help="write docs/report.md and its pictures too")
    parser.add_argument("--only", action="append", metavar="PREFIX", help="run the cases whose names begin so")
    parser.add_argument("--jobs", type=int, help="runs at a time (one a core)")
    parser.add_argument("--folder", help="where everything goes (build/report/SIZE)")
    options = parser.parse_args()
    folder = pathlib.Path(options.folder or runs.ROOT / "build" / "report" / options.size)
    wanted = [c for part in PARTS for c in part.cases(options.size)
              if not options.only or c.name.startswith(tuple(options.only))]  # fmt: skip
    troubles = {}
    try:
        if not options.page:
            began = time.monotonic()
            print(f"{len(wanted)} cases in {folder}")
            troubles = runs.main(wanted, folder, options.jobs)
            print(f"ran for {time.monotonic() - began:.0f} s")
    except runs.Trouble as e:
        sys.exit(f"report: {e}")
    if not options.runs:
        print(draw(options.size, folder, options.docs))
    return 1 if troubles else 0


if __name__ == "__main__":
    sys.exit(main())
