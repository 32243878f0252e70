"""Record, show, filter, export and import the expert's demonstrations.

python launch/demos.py record DEMOS [--successful] [--root DIR --split SPLIT] [--trials N]
python launch/demos.py list DEMOS [--episode N]
python launch/demos.py show DEMOS --episode N --out FILE.png|gif|mp4
python launch/demos.py filter DEMOS OUT [--successful] [--category NAME,...] [--object ID,...] [--max-steps N]
python launch/demos.py export DEMOS FILE.h5|FOLDER    ManiSkill's trajectory file, or a folder for LeRobot
python launch/demos.py import FILE.h5|FOLDER OUT      the same, or RecordEpisode's own
"""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL logs every memory map

if TYPE_CHECKING:
    from rich.table import Table

    from fb3d_rl.data.demonstrations import DemonstrationBuffer, EpisodeInfo


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (2: an error that the user can fix)."""
    options = _parser().parse_args(arguments)
    # Imported late: --help answers at once.
    from fb3d_rl.errors import exit_code

    return exit_code(
        lambda: COMMANDS[options.command](options), interrupted="episodes that record had finished are kept"
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, says: str, *paths: str) -> argparse.ArgumentParser:
        made = commands.add_parser(name, help=says, description=says)
        for path in paths:
            made.add_argument(path, type=Path, metavar=path.upper())
        return made

    record = command("record", "let the expert open parts, and keep what it does in the new folder DEMOS", "demos")
    record.add_argument("--root", help="folder of PartNet-Mobility objects; procedural ones unless given")
    record.add_argument("--split", default="all", help="which of them: a split, a category, ids (default: all)")
    record.add_argument("--categories", default="StorageFurniture,Microwave,KitchenPot", help="of procedural objects")
    record.add_argument("--objects", type=int, default=10, help="procedural objects of each category (default: 10)")
    record.add_argument("--trials", type=int, help="number of trials; one for each part that opens unless given")
    record.add_argument("--successful", action="store_true", help="keep only episodes that end with success")
    record.add_argument("--points", type=int, default=1200, help="points of a cloud (default: 1200)")
    record.add_argument("--horizon", type=int, default=150, help="control steps at most (default: 150)")
    record.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: one per core)")
    record.add_argument("--seed", type=int, default=0)

    listing = command("list", "print what is in DEMOS", "demos")
    listing.add_argument("--episode", type=int, help="all about this episode")

    show = command("show", "run an episode's actions again and draw it: a filmstrip (.png) or a film", "demos")
    show.add_argument("--episode", type=int, required=True)
    show.add_argument("--out", type=Path, required=True, help="file to write: .png, .gif or .mp4")
    show.add_argument("--root", help="folder of the objects, if they have moved since")

    choose = command("filter", "copy some episodes into the new folder OUT", "demos", "out")
    outcome = choose.add_mutually_exclusive_group()
    outcome.add_argument("--successful", action="store_true", help="those that end with success")
    outcome.add_argument("--failed", action="store_true", help="those that do not")
    choose.add_argument("--category", help="those of these categories, with commas")
    choose.add_argument("--object", help="those of these objects' ids, with commas")
    choose.add_argument("--min-steps", type=int, default=0, help="those that took at least this many control steps")
    choose.add_argument("--max-steps", type=int, help="those that took at most this many control steps")

    command("export", "write FILE.h5 (ManiSkill), else a folder (LeRobot)", "demos", "out")
    command("import", "read FILE.h5 (ManiSkill), else a folder (LeRobot), into the new folder DEMOS", "file", "demos")
    return parser


def record(options: argparse.Namespace) -> None:
    """Run the expert and keep its episodes."""
    from fb3d_rl.errors import UserError

    for key, least in (("objects", 1), ("trials", 1), ("points", 64), ("horizon", 1), ("workers", 1), ("seed", 0)):
        value = getattr(options, key)
        if value is not None and value < least:
            raise UserError(f"--{key} {value} is too small; give {least} or more")
    from rich.console import Console

    from fb3d_rl.data.demonstrations import DemonstrationBuffer
    from fb3d_rl.data.samples import SampleOptions
    from fb3d_rl.env.options import EnvOptions
    from fb3d_rl.env.torchrl_env import require_simulator
    from fb3d_rl.evaluation.evaluate import progress_bars
    from fb3d_rl.rollout.collectors import CollectorOptions, Episode
    from fb3d_rl.rollout.demonstrations import Assets, plan, recipe, record_expert
    from fb3d_rl.training.checkpoint import git_revision

    require_simulator()
    root = None if options.root is None else str(Path(options.root).resolve())
    assets = Assets(root, options.split, tuple(options.categories.split(",")), options.objects, options.seed)
    env = EnvOptions(points=options.points, horizon=options.horizon)
    samples = SampleOptions(points=env.points, views=env.views, camera=env.camera)
    with Console().status("looking for parts that open"):
        objects = assets.load()
        scheduled = plan(objects, samples, options.seed, options.trials)
    about = recipe(env, assets) | {
        "command": " ".join(["python", *sys.argv]),
        "seed": options.seed,
        "git_revision": git_revision(),
    }
    buffer = DemonstrationBuffer.create(options.demos, len(scheduled) * env.horizon, about)
    collector = CollectorOptions("direct" if options.workers == 1 else "process", options.workers)
    used = {item.trial.object for item in scheduled}
    crashed: list[str] = []
    with progress_bars() as bar:
        task = bar.add_task("trials", total=len(scheduled))

        def progress(episode: Episode, kept: bool) -> None:
            if episode.error:
                crashed.append(episode.error)
            bar.update(task, advance=1, description=f"trials ({len(buffer.episodes)} kept)")

        chosen = [obj for obj, _ in objects if obj.id in used]
        record_expert(buffer, chosen, scheduled, env, collector, options.successful, progress)
    _print(_summary(buffer))
    if crashed:
        print(f"{len(crashed)} of {len(scheduled)} trials crashed and are left out; the first: {crashed[0]}")
    if not len(buffer):
        raise UserError(f"none of the {len(scheduled)} trials was kept, so {options.demos} is empty")
    print(f"wrote {options.demos}")


def show_list(options: argparse.Namespace) -> None:
    """Print all episodes, or one."""
    from fb3d_rl.data.demonstrations import DemonstrationBuffer

    buffer = DemonstrationBuffer.open(options.demos)
    if options.episode is None:
        _print(_summary(buffer))
        return
    _print(_detail(buffer, _episode(buffer, options.episode)))


def show(options: argparse.Namespace) -> None:
    """Draw an episode."""
    from fb3d_rl.data.demonstrations import DemonstrationBuffer
    from fb3d_rl.errors import UserError

    if options.out.suffix not in (".png", ".gif", ".mp4"):
        raise UserError(
            f"--out {options.out} is neither a picture nor a film; choose a name that ends in .png, .gif or .mp4"
        )
    buffer = DemonstrationBuffer.open(options.demos)
    episode = _episode(buffer, options.episode)
    from fb3d_rl.drawing.video import require_encoder
    from fb3d_rl.env.torchrl_env import require_simulator
    from fb3d_rl.rollout.demonstrations import recorded_object, replay, trial_of
    from fb3d_rl.rollout.videos import write_filmstrip, write_video

    trial_of(buffer.episodes[episode])
    require_simulator()
    if options.out.suffix != ".png":
        require_encoder()
    film, exact = replay(buffer, episode, recorded_object(buffer, episode, options.root))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    (write_filmstrip if options.out.suffix == ".png" else write_video)(film, options.out)
    if not exact:
        print("the episode did not repeat exactly: object, program or machine differ from the recording's")
    print(f"wrote {options.out}")


def choose(options: argparse.Namespace) -> None:
    """Copy some episodes."""
    from fb3d_rl.data.demonstrations import DemonstrationBuffer

    categories, objects = (value and value.split(",") for value in (options.category, options.object))

    def keep(info: EpisodeInfo) -> bool:
        return (
            (info.success or not options.successful)
            and not (info.success and options.failed)
            and (categories is None or info.category in categories)
            and (objects is None or info.object in objects)
            and info.steps >= options.min_steps
            and (options.max_steps is None or info.steps <= options.max_steps)
        )

    copy = DemonstrationBuffer.open(options.demos).filter(options.out, keep)
    _print(_summary(copy))
    print(f"wrote {options.out}")


def export(options: argparse.Namespace) -> None:
    """Write another format."""
    from fb3d_rl.data import lerobot, maniskill
    from fb3d_rl.data.demonstrations import DemonstrationBuffer
    from fb3d_rl.env.options import EnvOptions

    buffer = DemonstrationBuffer.open(options.demos)
    if options.out.suffix == ".h5":
        maniskill.write(buffer, options.out)
    else:
        rate = buffer.about.get("env", {}).get("control_freq", EnvOptions().control_freq)
        lerobot.write(buffer, options.out, rate)
    print(f"wrote {options.out}")


def import_file(options: argparse.Namespace) -> None:
    """Read another format."""
    from fb3d_rl.data import lerobot, maniskill

    read = maniskill.read if options.file.suffix == ".h5" else lerobot.read
    _print(_summary(read(options.file, options.demos)))
    print(f"wrote {options.demos}")


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "record": record,
    "list": show_list,
    "show": show,
    "filter": choose,
    "export": export,
    "import": import_file,
}


def _episode(buffer: DemonstrationBuffer, episode: int) -> int:
    from fb3d_rl.errors import UserError

    if not 0 <= episode < len(buffer.episodes):
        raise UserError(f"{buffer.path} has {len(buffer.episodes)} episodes, the first is 0; there is no {episode}")
    return episode


def _summary(buffer: DemonstrationBuffer) -> Table:
    """A row for each category, and one for all."""
    from rich.table import Table

    table = Table(title=str(buffer.path), box=None)
    for name in ("category", "objects", "episodes", "steps", "steps each", "success", "success rate"):
        table.add_column(name, justify="left" if name == "category" else "right")
    groups: dict[str, list[EpisodeInfo]] = {}
    for info in sorted(buffer.episodes, key=lambda info: info.category):
        groups.setdefault(info.category, []).append(info)
    for name, infos in [*groups.items(), ("all", buffer.episodes)]:
        rows, won = sum(info.rows for info in infos), sum(info.success for info in infos)
        count = max(len(infos), 1)
        cells = len({info.object for info in infos}), len(infos), rows, round(rows / count), won
        table.add_row(name, *map(str, cells), f"{100 * won / count:.0f} %", style="bold" if name == "all" else None)
    return table


def _detail(buffer: DemonstrationBuffer, episode: int) -> Table:
    """Everything that the buffer knows about an episode."""
    from rich.table import Table

    info, frames = buffer.episodes[episode], buffer.frames(episode)
    held = frames["observation", "attached"].flatten().nonzero().flatten().tolist()
    first = buffer.first_row(episode)
    facts = {
        "object": f"{info.object} ({info.category}), link {info.link}",
        "start": ", ".join(f"{q:.3f}" for q in info.start) or "unknown",
        "camera": f"azimuth {info.view.azimuth:.1f}, elevation {info.view.elevation:.1f} degrees",
        "seed, round": f"{info.seed}, {info.round}",
        "outcome": f"{'success' if info.success else 'failure'}, normalized distance {info.normalized_distance:.3f}",
        "steps": f"{info.steps}, of which {info.rows} are kept in rows {first} to {first + info.rows - 1}",
        "expert acts": f"in {100 * frames['expert', 'acts'].float().mean():.0f} % of the steps",
        "who acted": _who_acted(frames["expert", "acts"].flatten().tolist()),
        "holds": f"from step {held[0]} on, in {len(held)} steps" if held else "never",
    }
    table = Table(title=f"{buffer.path}, episode {episode}", box=None, show_header=False)
    for name, value in facts.items():
        table.add_row(name, value)
    for key, (shape, dtype) in buffer.keys.items():
        name = ".".join(key) if isinstance(key, tuple) else key
        table.add_row(name, f"{list(shape)} {str(dtype).removeprefix('torch.')}", style="dim")
    return table


def _who_acted(expert: list[bool], width: int = 60) -> str:
    """Who acted along an episode, in at most ``width`` letters: E the expert, L the learner, x both."""
    count = min(width, len(expert))
    parts = [expert[len(expert) * k // count : len(expert) * (k + 1) // count] for k in range(count)]
    return "".join("E" if all(part) else "x" if any(part) else "L" for part in parts)


def _print(table: Table) -> None:
    from rich.console import Console

    Console().print(table)


if __name__ == "__main__":
    interrupt.run(main)
