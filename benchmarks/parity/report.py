"""What the campaign found, as a report: a table each for what was asked, sizes side by side."""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from benchmarks.parity.campaign import SizeReport
from benchmarks.parity.episodes import FIRST_OFF, NOT_EXPLAINED, Episodes
from benchmarks.parity.onestep import DEFECT_OFF, LIMITS
from benchmarks.report import Report, Table

NEAR = LIMITS.index(1e-4)


def report_of(sizes: Sequence[SizeReport], settings: Mapping[str, Any], reference: Mapping[str, str]) -> Report:
    """Of the campaign of some sizes; its fault is what nothing explains."""
    found = unexplained(sizes)
    more = f" and {len(found) - 3} more" if len(found) > 3 else ""
    fault = (
        f"Rounding does not explain {len(found)} differences from the reference ({'; '.join(found[:3])}{more}): "
        "--json lists them; look for a defect of the engine."
    )
    return Report(
        title="Agreement with the reference",
        results=[{"settings": dict(settings), "sizes": [asdict(one) for one in sizes]}],
        tables=tables(sizes),
        notes=[f"NOT EXPLAINED: {text}" for text in found],
        reference=reference,
        fault=fault if found else "",
    )


def unexplained(sizes: Iterable[SizeReport]) -> list[str]:
    """Where states and episodes come from that nothing explains."""
    found = []
    for one in sizes:
        found += [f"size {one.size}, {state.origin}" for state in one.one_step.off if not state.explained]
        pairs = one.episodes.parted if one.episodes else []
        found += [f"size {one.size}, episode of {pair.origin}" for pair in pairs if pair.reason == NOT_EXPLAINED]
    return found


def tables(sizes: Sequence[SizeReport]) -> list[Table]:
    made = [states(sizes), fields(sizes), scenes(sizes), causes(sizes)]
    if played := {one.size: one.episodes for one in sizes if one.episodes}:
        made += [episodes(played), reasons(played)]
    return [*made, defect(sizes)]


def states(sizes: Sequence[SizeReport]) -> Table:
    """A row a size: how many states are how near."""
    within = [f"within {limit:.0e}" for limit in LIMITS]
    rows = []
    for one in sizes:
        of = one.one_step.scenes[-1]
        shares = (f"{share:.2%}" for share in of.within)
        rows.append([one.size, f"{of.states:,}", *shares, f"{of.median:.1e}", *map(str, (of.other_contacts, of.off))])
    head = ("size", "states", *within, "median", "other contacts", "looked into")
    return Table(head, rows, "One physics step: largest difference of any place or speed (m, rad, m/s, rad/s)")


def fields(sizes: Sequence[SizeReport]) -> Table:
    """A row a field: median / 99.9% / states above 1e-3 of each size."""
    of_size = [{row.field: row for row in one.one_step.fields} for one in sizes]
    rows = []
    for name, first in of_size[0].items():
        cells = [f"{of[name].median:.1g} / {of[name].p999:.1g} / {of[name].above}" for of in of_size]
        rows.append([name.replace("_", " "), first.unit, *cells])
    head = ("field", "unit", *(one.size for one in sizes))
    return Table(head, rows, "By field: median / 99.9% / states off by more than 1e-3")


def scenes(sizes: Sequence[SizeReport]) -> Table:
    cell = lambda of: f"{of.within[NEAR]:.1%} ({of.off})"
    of_size = {one.size: {row.scene: cell(row) for row in one.one_step.scenes[:-1]} for one in sizes}
    return side_by_side("scene", of_size, "-", "By scene: states within 1e-4 in places and speeds (looked into)")


def causes(sizes: Sequence[SizeReport]) -> Table:
    of_size = {one.size: {name: str(count) for name, count in one.one_step.causes.items()} for one in sizes}
    return side_by_side("cause", of_size, "0", "States that were looked into, by cause")


def defect(sizes: Sequence[SizeReport]) -> Table:
    rows = []
    for one in sizes:
        of = one.one_step.defect
        rows.append([one.size, f"{of.states:,}", *map(str, of.differ), f"{of.largest:,.0f}"])
    head = ("size", "states", *(f"other by {limit:.0e}" for limit in DEFECT_OFF), "largest")
    return Table(head, rows, "What the fix of the padding defect changes in one step of ours (m, rad, m/s, rad/s)")


def episodes(played: Mapping[str, Episodes]) -> Table:
    share = lambda value: "-" if value is None else f"{value:.1%}"
    rows = []
    for size, of in played.items():
        shares = (of.same, of.same_touched, of.target, of.reference_itself, of.ours_itself)
        rows.append([size, f"{of.pairs:,}", str(of.touched), *map(share, shares)])
    shares = ("same outcome", "of those that touch", "asked for", "reference and itself", "ours and itself")
    title = "Whole episodes; an engine and itself: from starts one unit in the last place away"
    return Table(("size", "episodes", "end by touching", *shares), rows, title)


def reasons(played: Mapping[str, Episodes]) -> Table:
    rows = []
    for size, of in played.items():
        for reason, count in of.reasons.items():
            pairs = [pair for pair in of.parted if pair.reason == reason]
            medians = [_median(pair.first_off[k] for pair in pairs) for k in range(len(FIRST_OFF))]
            rows.append([size, reason, str(count), *medians, str(sum(pair.at_contact for pair in pairs))])
    head = ("size", "reason", "episodes", *(f"off by {limit:.0e} at env step" for limit in FIRST_OFF), "at a contact")
    return Table(head, rows, "Why episodes part (medians)")


def side_by_side(what: str, of_size: Mapping[str, Mapping[str, str]], missing: str, title: str) -> Table:
    """A row for each name that some size has, a column a size."""
    names = dict.fromkeys(name for of in of_size.values() for name in of)
    rows = [[name, *(of.get(name, missing) for of in of_size.values())] for name in names]
    return Table((what, *of_size), rows, title)


def _median(steps: Iterable[int | None]) -> str:
    known = [step for step in steps if step is not None]
    return f"{statistics.median(known):.0f}" if known else "-"
