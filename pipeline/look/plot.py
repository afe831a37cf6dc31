"""Figure of a manifest: histograms of numeric columns, and learning curves."""

from pathlib import Path

import numpy as np
import pyarrow as pa

from levelproof.experts.labels import TRAINED, Label
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.figures import draw_panels
from levelproof.pipeline.look.query import RowQuery, prepare_for_seeds
from levelproof.pipeline.look.spread import spread
from levelproof.pipeline.read.select import columns_in, labelled, select
from levelproof.pipeline.store.created import writing_to
from levelproof.pipeline.store.files import replacing
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.urls import as_typed
from levelproof.pipeline.words import many

KINDS = (".svg", ".png")
NUMBERS = ("steps_to_goal", "steps_to_first_success", "env_steps", "success_rate", "portability")
BINS = 32
CURVES = 100  # maximum number of learning curves per label, spread evenly over levels


def plot(split: Path, query: RowQuery, out: Path) -> None:
    """Draw the rows that `query` selects to `out`; print one line about the figure.

    Raises:
        UserError: no split, no matching row, or the file cannot be written.
        Failure: a fragment is damaged.
    """
    if out.suffix.lower() not in KINDS:
        raise UserError(f"Cannot draw to {out}: its name must end in {' or '.join(KINDS)}.")
    prepare_for_seeds(split)
    manifest = require_manifest(split, ["label", *NUMBERS, *columns_in(query.where)])
    table = select(manifest.table, query.where)
    numbers = [name for name in NUMBERS if not (name == "env_steps" and manifest.repeats)]  # seeds leave costs behind
    trained = table.filter(pa.array(labelled(table, TRAINED)))  # other levels have success rates without an expert
    rows = lambda name: trained if name == "success_rate" else table
    values = {name.replace("_", " "): rows(name)[name].drop_null().to_numpy() for name in numbers}
    values = {name: column[~np.isnan(column)] for name, column in values.items()}
    values = {name: column for name, column in values.items() if len(column)}
    drawn = {label: _curves(split, table, label) for label in sorted(TRAINED)}
    curves = {f"{label} levels, success rate": rates for label, rates in drawn.items() if rates}
    if not values and not curves:
        raise UserError(f"{split} has nothing to draw: choose other rows with --where.")
    with writing_to(out), replacing(out) as unfinished:
        draw_panels(values, curves, BINS, f"{as_typed(split)}: {many(table.num_rows, 'level')}", unfinished)
    print(f"{out}: {', '.join([*values, *curves])}")


def _curves(split: Path, table: pa.Table, label: Label) -> list[np.ndarray]:
    """Read success rates per update of up to CURVES levels of a label; NaN where no episode ended."""
    ids = table["level_id"].to_numpy()[labelled(table, [label])]
    if not len(ids):
        return []
    chosen = ids[spread(len(ids), CURVES)]
    curves = require_manifest(split, ["learning_curve"], chosen).table["learning_curve"].to_pylist()
    return [curve for rates in curves if not np.isnan(curve := np.array(rates, np.float64)).all()]
