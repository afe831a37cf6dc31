"""The campaign's report, with sizes side by side in each table."""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from benchmarks.parity.campaign import SizeReport
from benchmarks.parity.episodes import FIRST_OFF, NOT_EXPLAINED, Episodes
from benchmarks.parity.onestep import DEFECT_OFF, LIMITS
from benchmarks.report import Report, Table
from benchmarks.statistics import too_few

NEAR = LIMITS.index(1e-4)


def report_of(sizes: Sequence[SizeReport], settings: Mapping[str, Any], reference: Mapping[str, str]) -> Report:
    """Report the campaign of some sizes; unexplained differences are its fault."""
    differences = unexplained(sizes)
    more = f" and {len(differences) - 3} more" if len(differences) > 3 else ""
    fault = (
        f"Rounding does not explain {len(differences)} differences from the reference "
        f"({'; '.join(differences[:3])}{more}): --json lists them; look for a defect of the engine."
    )
    return Report(
        title="Agreement with the reference",
        results=[{"settings": dict(settings), "sizes": [asdict(one) for one in sizes]}],
        tables=tables(sizes),
        notes=[f"NOT EXPLAINED: {text}" for text in differences],
        reference=reference,
        fault=fault if differences else "",
    )


def unexplained(sizes: Iterable[SizeReport]) -> list[str]:
    """List the sources of unexplained states and episodes, and sizes with too few episodes alike."""
    differences = []
    for one in sizes:
        differences += [f"size {one.size}, {state.origin}" for state in one.one_step.off if not state.explained]
        if not (played := one.episodes):
            continue
        pairs = [pair for pair in played.parted if pair.reason == NOT_EXPLAINED]
        differences += [f"size {one.size}, episode of {pair.origin}" for pair in pairs]
        if played.target and too_few(round(played.same * played.pairs), played.pairs, played.target):
            differences.append(f"size {one.size}, {played.same:.1%} of episodes alike instead of {played.target:.0%}")
    return differences


def tables(sizes: Sequence[SizeReport]) -> list[Table]:
    result = [states(sizes), fields(sizes), scenes(sizes), causes(sizes)]
    if played := {one.size: one.episodes for one in sizes if one.episodes}:
        result += [episodes(played), reasons(played)]
    return [*result, defect(sizes)]


def states(sizes: Sequence[SizeReport]) -> Table:
    """Make a row per size: the shares of states within each limit."""
    within = [f"within {limit:.0e}" for limit in LIMITS]
    rows = []
    for one in sizes:
        scene = one.one_step.scenes[-1]
        shares = (f"{share:.2%}" for share in scene.within)
        rows.append(
            [
                one.size,
                f"{scene.states:,}",
                *shares,
                f"{scene.median:.1e}",
                *map(str, (scene.other_contacts, scene.off)),
            ]
        )
    head = ("size", "states", *within, "median", "other contacts", "investigated")
    return Table(head, rows, "One physics step: largest difference of any position or speed (m, rad, m/s, rad/s)")


def fields(sizes: Sequence[SizeReport]) -> Table:
    """Make a row per field: median / 99.9% / states above 1e-3 of each size."""
    of_size = [{row.field: row for row in one.one_step.fields} for one in sizes]
    rows = []
    for name, first in of_size[0].items():
        cells = [
            f"{by_field[name].median:.1g} / {by_field[name].p999:.1g} / {by_field[name].above}" for by_field in of_size
        ]
        rows.append([name.replace("_", " "), first.unit, *cells])
    head = ("field", "unit", *(one.size for one in sizes))
    return Table(head, rows, "By field: median / 99.9% / states off by more than 1e-3")


def scenes(sizes: Sequence[SizeReport]) -> Table:
    cell = lambda row: f"{row.within[NEAR]:.1%} ({row.off})"
    of_size = {one.size: {row.scene: cell(row) for row in one.one_step.scenes[:-1]} for one in sizes}
    return side_by_side("scene", of_size, "-", "By scene: states within 1e-4 in positions and speeds (investigated)")


def causes(sizes: Sequence[SizeReport]) -> Table:
    of_size = {one.size: {name: str(count) for name, count in one.one_step.causes.items()} for one in sizes}
    return side_by_side("cause", of_size, "0", "Investigated states, by cause")


def defect(sizes: Sequence[SizeReport]) -> Table:
    rows = []
    for one in sizes:
        defect_row = one.one_step.defect
        rows.append([one.size, f"{defect_row.states:,}", *map(str, defect_row.differ), f"{defect_row.largest:,.0f}"])
    head = ("size", "states", *(f"differ by {limit:.0e}" for limit in DEFECT_OFF), "largest")
    return Table(head, rows, "What the fix of the padding defect changes in one step of ours (m, rad, m/s, rad/s)")


def episodes(played: Mapping[str, Episodes]) -> Table:
    share = lambda value: "-" if value is None else f"{value:.1%}"
    rows = []
    for size, result in played.items():
        shares = (result.same, result.target, result.same_touched, result.reference_itself, result.ours_itself)
        rows.append([size, f"{result.pairs:,}", str(result.touched), *map(share, shares)])
    shares = ("same outcome", "target", "of those that touch", "reference and itself", "ours and itself")
    title = "Whole episodes; an engine and itself: from starts one unit in the last place away"
    return Table(("size", "episodes", "end by touching", *shares), rows, title)


def reasons(played: Mapping[str, Episodes]) -> Table:
    rows = []
    for size, result in played.items():
        for reason, count in result.reasons.items():
            pairs = [pair for pair in result.parted if pair.reason == reason]
            medians = [_median(pair.first_off[k] for pair in pairs) for k in range(len(FIRST_OFF))]
            rows.append([size, reason, str(count), *medians, str(sum(pair.at_contact for pair in pairs))])
    head = ("size", "reason", "episodes", *(f"off by {limit:.0e} at env step" for limit in FIRST_OFF), "at a contact")
    return Table(head, rows, "Why outcomes differ (medians)")


def side_by_side(what: str, of_size: Mapping[str, Mapping[str, str]], missing: str, title: str) -> Table:
    """Make a row per name that any size has, and a column per size."""
    names = dict.fromkeys(name for cells in of_size.values() for name in cells)
    rows = [[name, *(cells.get(name, missing) for cells in of_size.values())] for name in names]
    return Table((what, *of_size), rows, title)


def _median(steps: Iterable[int | None]) -> str:
    known = [step for step in steps if step is not None]
    return f"{statistics.median(known):.0f}" if known else "-"
