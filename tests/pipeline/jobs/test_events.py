"""Events of a run: bounded in number, and consistent with the tally."""

import json

import pytest

from levelproof.experts.steps import EnvSteps, Seconds
from levelproof.pipeline.jobs import events as events_file
from levelproof.pipeline.jobs.events import MAX_EVENTS, Events
from levelproof.pipeline.jobs.progress import Tally
from levelproof.pipeline.jobs.schedule import Order, Scheduler, Summary, UnitOutcome, WorkUnit


def test_events_publish_the_start_the_latest_events_and_the_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events_file, "EVERY", 0.0)
    published: list[list] = []
    units = [WorkUnit(range(2 * i, 2 * i + 2)) for i in range(3 * MAX_EVENTS)]
    tally, scheduler = Tally(len(units) * 2, 0, 0), Scheduler(iter(units), len(units) * 2, 2)
    scheduler.join("here", 0.0)
    assert isinstance(scheduler.order("here", 0.0), Order)
    events = Events(tally, scheduler, "levelproof generate", lambda events: published.append(list(events)))
    for unit in units:
        tally.ended(unit, summary := Summary(2, 1, EnvSteps(trained=100), Seconds(training=0.5)))
        events.ended(UnitOutcome(unit, summary))
    jax_s = "\n--------------------\nFor simplicity, JAX has removed its internal frames.\n"
    events.ended(UnitOutcome(units[0], reason=f"Traceback\n\nValueError: of this one{jax_s}"))
    events.ended(UnitOutcome(units[0], reason="ValueError: again"), given_up=True)
    events.refresh(1234.4, 60.2)
    (began, *latest, state) = published[-1]
    assert (began["event"], began["command"], len(latest)) == ("started", "levelproof generate", MAX_EVENTS)
    assert latest[0]["unit"] == units[-MAX_EVENTS + 2].name
    assert latest[0]["seconds"]["training"] == 0.5
    assert [(event["event"], event["cause"]) for event in latest[-2:]] == [
        ("failed", "ValueError: of this one"),
        ("quarantined", "ValueError: again"),
    ]
    assert (state["event"], state["done"], state["solved"]) == ("progress", 6 * MAX_EVENTS, 3 * MAX_EVENTS)
    assert (state["rate"], state["left"], state["failures"], state["env_steps"]) == (1234, 60, 2, 300 * MAX_EVENTS)
    assert (state["spent"]["trained"], state["seconds"]["training"]) == (300 * MAX_EVENTS, 1.5 * MAX_EVENTS)
    assert state["workers"]["here"]["count"] == 1
    assert sum(len(json.dumps(event)) for event in published[-1]) < 2**20
    tally.unsealed = 1
    events.refresh(0.0, None)
    assert published[-1][-1]["workers"] == {}, "they have ended, and are not silent"
    assert published[-1][-1]["unsealed"] == 1
    events.over("stopped")
    assert (published[-1][-1]["event"], published[-1][-1]["how"]) == ("ended", "stopped")
