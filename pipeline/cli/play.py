"""`levelproof play`: control and edit a level in a browser, and train an expert for it."""

import argparse
from pathlib import Path

SUMMARY = "play, edit and solve a level by hand, in a browser"
EXAMPLE = """levelproof play data/128k/s 7
levelproof play level.json
levelproof play --size l
levelproof play data/128k/s 7 --policy policy/"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    source = "folder or URL of a split, a seed file, or a level file such as level.json (default: an empty level)"
    parser.add_argument("source", type=Path, nargs="?", metavar="SOURCE", help=source)
    parser.add_argument("level_id", type=int, nargs="?", metavar="LEVEL_ID", help="id of a level of the split")
    parser.add_argument("--size", help="size of an empty level (default: m)")
    parser.add_argument("--budget", default="256k", help="env steps of an expert (default: 256k)")
    policy = "policy that plays on request: a folder, builtin:s or builtin:m (default: builtin:s)"
    parser.add_argument("--policy", type=Path, default=Path("builtin:s"), metavar="POLICY", help=policy)
    parser.add_argument("--port", type=int, default=8777, help="port to listen on; 0: any (default: 8777)")
    parser.add_argument("--no-browser", action="store_true", help="do not open the page")


def run(arguments: argparse.Namespace) -> None:
    from levelproof.pipeline.play.open import play

    play(
        arguments.source,
        arguments.level_id,
        arguments.size,
        arguments.budget,
        arguments.port,
        not arguments.no_browser,
        arguments.policy,
    )
