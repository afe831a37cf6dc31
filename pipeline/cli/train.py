"""`levelproof train`: train one policy by reinforcement on many levels, from scratch or from another policy."""

import argparse
from pathlib import Path

SUMMARY = "train one policy by reinforcement learning on many levels, from scratch or from another policy"
EXAMPLE = """\
levelproof train size=s -o agent/
levelproof train size=m start=policy/ levels=learnability ppo.env_steps=100M -o tuned/
levelproof train levels=data/128k/s start=policy/ -o tuned/"""
HELP = "settings to change as NAME=VALUE; docs/finetune.md and docs/curricula.md list them"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("words", nargs="*", metavar="NAME=VALUE", help=HELP)
    out = "folder to write; the same command continues a run that was stopped (default: agent)"
    parser.add_argument("-o", "--out", type=Path, default=Path("agent"), help=out)


def run(arguments: argparse.Namespace) -> None:
    from rich.console import Console

    from levelproof.configs.compose import compose_train
    from levelproof.pipeline.learn.train import train

    train(compose_train(arguments.words), arguments.out, Console(stderr=True))
