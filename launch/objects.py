"""Make procedural objects; import, unpack, list, validate, preview and compare objects.

python launch/objects.py generate --out DIR [--categories all|train|test|mechanisms|NAME,...] [--count 50] [--seed 0]
python launch/objects.py import PATH... --out DIR [--category NAME] [--package DIR] [--body NAME] [--scale mm] [--up y]
                                [--front -y]
python launch/objects.py unpack ARCHIVE --out DIR
python launch/objects.py list PATH [--split SPLIT]
python launch/objects.py validate PATH [--out FILE.json] [--workers N]
python launch/objects.py preview PATH --out FILE.png|html [--split SPLIT] [--each N]
python launch/objects.py compare DIR OTHER [--out FILE.json] [--workers N]

PATH is a folder of PartNet-Mobility objects, a file such as a URDF or MJCF, or a folder of such files.
"""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

SIDES = ("auto", "-x", "+x", "-y", "+y")
"""What ``--front`` takes."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (1: validate found an object that is broken; 2: a mistake)."""
    options = _parser().parse_args(joined(sys.argv[1:] if arguments is None else arguments))
    # Imported late: --help answers at once.
    from fb3d_rl.errors import exit_code

    return exit_code(lambda: COMMANDS[options.command](options), interrupted="objects that were finished are kept")


def joined(words: Sequence[str]) -> list[str]:
    """The words with "--front -x" as "--front=-x": argparse would take the side for an option."""
    found: list[str] = []
    for word in words:
        if found and found[-1] == "--front" and word in SIDES:
            found[-1] += f"={word}"
        else:
            found.append(word)
    return found


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    says = "write procedural objects as PartNet-Mobility folders DIR/<id>"
    make = commands.add_parser("generate", help=says, description=says)
    make.add_argument("--out", type=Path, required=True, metavar="DIR")
    make.add_argument(
        "--categories",
        default="all",
        help="all, train or test (UMPNet's 21 categories or halves of them), mechanisms (buttons, levers, caps, "
        "blades, wheels ... on bodies of any kind), or names such as Box or AmbiguousDoor, with commas (default: all)",
    )
    make.add_argument("--count", type=int, default=50, help="objects of each category (default: 50)")
    make.add_argument("--seed", type=int, default=0)

    says = "import objects from files of other makers, such as URDFs and MJCFs, as PartNet-Mobility folders DIR/<id>"
    take = commands.add_parser("import", help=says, description=says)
    take.add_argument("paths", nargs="+", metavar="PATH", help="a file, or a folder of files")
    take.add_argument("--out", type=Path, required=True, metavar="DIR")
    take.add_argument(
        "--category", help="of all of them (default: that of meta.json or of a folder's name, else unknown)"
    )
    take.add_argument(
        "--package", action="append", default=[], metavar="DIR", help="a folder that package://NAME/ means"
    )
    take.add_argument("--body", metavar="NAME", help="of MJCFs take this body and what it carries (default: all)")
    take.add_argument(
        "--scale",
        default="auto",
        help="the files' unit, m, mm, cm, inch or the metres in one; auto recognises it by the objects' size (default)",
    )
    take.add_argument("--up", default="z", choices=("z", "y"), help="which axis points up (default: z)")
    take.add_argument(
        "--front",
        default="auto",
        choices=SIDES,
        help="where the front faces once z is up (default: auto, where the parts open to)",
    )

    says = "unpack a .zip or .tar archive of objects; nothing in it can leave DIR"
    unzip = commands.add_parser("unpack", help=says, description=says)
    unzip.add_argument("archive", type=Path, metavar="ARCHIVE")
    unzip.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to make")

    says = "list the objects at or below PATH: category, split, parts"
    table = commands.add_parser("list", help=says, description=says)
    table.add_argument("dir", metavar="PATH")
    table.add_argument("--split", default="all", help="a split, categories, ids or files, with commas (default: all)")

    says = "list what is wrong with the objects at or below PATH; the exit code is 1 if one of them cannot be used"
    check = commands.add_parser("validate", help=says, description=says)
    check.add_argument("dir", type=Path, metavar="PATH")
    check.add_argument("--out", type=Path, help="file to write (default: validation.json in the folder)")
    check.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: one per core)")

    says = "draw the objects at or below PATH, closed and open, with their joint axes"
    show = commands.add_parser("preview", help=says, description=says)
    show.add_argument("dir", type=Path, metavar="PATH")
    show.add_argument("--out", type=Path, required=True, help="file to write: .png or .html")
    show.add_argument("--split", default="all", help="a split, categories or ids, with commas (default: all)")
    show.add_argument("--each", type=int, default=8, help="at most so many of each category (default: 8)")

    says = "tell how the objects below DIR differ from those below OTHER, such as real from procedural ones"
    differ = commands.add_parser("compare", help=says, description=says)
    differ.add_argument("dir", type=Path, metavar="DIR")
    differ.add_argument("other", type=Path, metavar="OTHER")
    differ.add_argument("--out", type=Path, help="also write all numbers to this file, .json")
    differ.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: one per core)")
    return parser


def generate(options: argparse.Namespace) -> None:
    """Write procedural objects."""
    from rich.progress import Progress

    from fb3d_rl import procedural
    from fb3d_rl.assets.catalog import expand

    categories = expand(list(filter(None, options.categories.split(","))))
    procedural.check(categories, options.count, options.seed)
    with Progress() as bar:
        task = bar.add_task("objects", total=len(categories) * options.count)
        for category in categories:
            bar.update(task, description=category)
            procedural.generate(options.out, [category], options.count, options.seed, lambda: bar.advance(task))
        bar.update(task, description="objects")
    print(f"{len(categories) * options.count} objects of {len(categories)} categories: {options.out}")


def unpack(options: argparse.Namespace) -> None:
    """Unpack an archive."""
    from rich.progress import DownloadColumn, Progress, TimeElapsedColumn

    from fb3d_rl.assets.archive import unpack
    from fb3d_rl.assets.folders import find_folders

    with Progress(DownloadColumn(), TimeElapsedColumn()) as bar:
        task = bar.add_task("", total=None)
        unpack(options.archive, options.out, lambda size: bar.advance(task, size))
    print(f"{len(find_folders(options.out))} objects: {options.out}")


def take(options: argparse.Namespace) -> int:
    """Import files."""
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import track
    from rich.table import Table

    from fb3d_rl.assets.options import AssetsOptions
    from fb3d_rl.errors import UserError
    from fb3d_rl.importer.catalog import frame_of, imported
    from fb3d_rl.importer.files import find_files
    from fb3d_rl.kinematics.opening import openable_links

    frame = frame_of(AssetsOptions(scale=options.scale, up=options.up, front=options.front))
    sources = find_files(options.paths, options.package, options.body)
    taken = [source.id for source in sources if (options.out / source.id).exists()]
    if taken:
        raise UserError(f"{options.out / taken[0]} exists already; choose another --out or remove it")
    table = Table(box=box.SIMPLE_HEAD)
    for name in ("object", "category", "parts that open", "what was changed or dropped"):
        table.add_column(name, overflow="fold")
    broken = 0
    for source in track(sources, "objects", transient=True):
        try:
            obj, remarks = imported(source, frame, options.category, options.out)
        except UserError as error:
            broken += 1
            table.add_row(source.id, "", "", f"[red]{escape(str(error))}[/red]")
            continue
        table.add_row(obj.id, obj.category, str(len(openable_links(obj))), escape("\n".join(remarks)))
    Console().print(table)
    print(f"{len(sources) - broken} objects: {options.out}; {broken} cannot be used (red)")
    return 1 if broken else 0


def listing(options: argparse.Namespace) -> None:
    """List objects."""
    from collections import Counter

    from rich import box
    from rich.console import Console
    from rich.table import Table

    from fb3d_rl.importer.catalog import path_catalog
    from fb3d_rl.kinematics.opening import openable_links

    table = Table(box=box.SIMPLE_HEAD)
    for name in ("object", "category", "split", "joints", "parts that open"):
        table.add_column(name, overflow="fold")
    entries = path_catalog(options.dir, options.split)
    for entry in sorted(entries, key=lambda entry: (entry.category, entry.id)):
        obj = entry.load()
        parts = Counter(obj.links[link].semantic or "no name" for link in openable_links(obj))
        names = ", ".join(f"{count} {name}" for name, count in sorted(parts.items()))
        table.add_row(entry.id, entry.category, entry.split, str(len(obj.movable)), names)
    Console().print(table)
    splits = Counter(entry.split for entry in entries)
    counts = ", ".join(f"{count} {split}" for split, count in sorted(splits.items()))
    print(f"{len(entries)} objects of {len({entry.category for entry in entries})} categories: {counts}")


def preview(options: argparse.Namespace) -> None:
    """Draw a contact sheet."""
    from collections import Counter

    from rich.progress import track

    from fb3d_rl.errors import UserError
    from fb3d_rl.importer.catalog import path_catalog
    from fb3d_rl.report import preview

    if options.out.suffix not in (".png", ".html"):
        raise UserError(f"--out {options.out} is neither a .png nor a .html file; give one of them")
    if options.each < 1:
        raise UserError(f"--each {options.each} is too small; give 1 or more")
    entries = sorted(path_catalog(options.dir, options.split), key=lambda entry: (entry.category, entry.id))
    seen: Counter[str] = Counter()
    objects = []
    for entry in entries:
        seen[entry.category] += 1
        if seen[entry.category] <= options.each:
            objects.append(entry.load())
    pictures = [preview.picture(obj) for obj in track(objects, "pictures")]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    preview.write_sheet(objects, options.out, f"Objects of {options.dir.resolve().name}", pictures)
    print(f"wrote {options.out}: {len(objects)} of {len(entries)} objects")


def validate(options: argparse.Namespace) -> int:
    """List flaws."""
    from rich import box
    from rich.console import Console
    from rich.progress import track
    from rich.table import Table

    from fb3d_rl.assets.folders import find_folders
    from fb3d_rl.children import withheld, worker_pool
    from fb3d_rl.errors import UserError
    from fb3d_rl.files import write_text
    from fb3d_rl.importer.catalog import holds_folders
    from fb3d_rl.importer.files import find_files
    from fb3d_rl.importer.reading import examine_file
    from fb3d_rl.kinematics.validation import examine

    if options.workers < 1:
        raise UserError(f"--workers {options.workers} is too small; give 1 or more")
    folders = list(find_folders(options.dir).values()) if holds_folders(options.dir) else []
    sources = [] if folders else find_files(options.dir)
    with worker_pool(options.workers) as pool:
        with withheld():
            examined = pool.map(examine, folders) if folders else pool.map(examine_file, sources)
        verdicts = list(track(examined, "objects", len(folders or sources)))
    table = Table(box=box.SIMPLE_HEAD)
    for name in ("object", "category", "parts that open", "what is wrong"):
        table.add_column(name, overflow="fold")
    for verdict in verdicts:
        texts = [f"[red]{item.what}[/red]" if item.serious else item.what for item in verdict.findings]
        table.add_row(verdict.id, verdict.category, str(verdict.openable), "\n".join(texts))
    Console().print(table)
    broken = [verdict for verdict in verdicts if not verdict.usable]
    out = options.out or (options.dir if options.dir.is_dir() else options.dir.parent) / "validation.json"
    write_text(out, json.dumps([verdict.entry() for verdict in verdicts], indent=1) + "\n")
    noted = sum(bool(verdict.findings) for verdict in verdicts) - len(broken)
    print(f"{len(verdicts)} objects: {len(broken)} cannot be used (red), {noted} more with a remark; wrote {out}")
    return 1 if broken else 0


def compare(options: argparse.Namespace) -> None:
    """Tell how two kinds of objects differ."""
    from dataclasses import asdict

    from rich import box
    from rich.console import Console
    from rich.progress import track
    from rich.table import Table

    from fb3d_rl.assets.folders import find_folders
    from fb3d_rl.children import withheld, worker_pool
    from fb3d_rl.errors import UserError
    from fb3d_rl.evaluation import likeness
    from fb3d_rl.files import write_text

    if options.workers < 1:
        raise UserError(f"--workers {options.workers} is too small; give 1 or more")
    kinds = [list(find_folders(folder).values()) for folder in (options.dir, options.other)]
    described: list[dict[str, list[Any]]] = [{}, {}]
    with worker_pool(options.workers) as pool:
        with withheld():
            found = pool.map(likeness.of_folder, [*kinds[0], *kinds[1]])
        for i, (category, numbers) in enumerate(track(found, "objects", sum(map(len, kinds)))):
            described[i >= len(kinds[0])].setdefault(category, []).append(numbers)
    compared = likeness.compare(described[0], described[1])
    if not compared:
        raise UserError(
            f"no category has {likeness.FEWEST} objects both in {options.dir} and in {options.other}; give more objects"
        )
    table = Table(box=box.SIMPLE_HEAD)
    for name in ("category", "objects", "told apart", "what tells them best: mean of DIR, of OTHER (by itself)"):
        table.add_column(name, overflow="fold")
    for item in compared:
        telling = [
            f"{likeness.FEATURES[i]}: {item.means[i][0]:.2f}, {item.means[i][1]:.2f} ({item.apart[i]:.0%})"
            for i in item.telling()
        ]
        table.add_row(item.category, "{} / {}".format(*item.counts), f"{item.told:.0%}", "\n".join(telling))
    Console().print(table)
    print("Told apart: of all pairs, one object of each kind, those that a classifier orders rightly; 50 % is chance.")
    if options.out:
        content = {"features": likeness.FEATURES, "categories": [asdict(item) for item in compared]}
        write_text(options.out, json.dumps(content, indent=1) + "\n")


COMMANDS: dict[str, Callable[[argparse.Namespace], int | None]] = {
    "generate": generate,
    "import": take,
    "unpack": unpack,
    "list": listing,
    "validate": validate,
    "preview": preview,
    "compare": compare,
}

if __name__ == "__main__":
    interrupt.run(main)
