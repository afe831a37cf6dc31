"""The server of `play` over a real websocket, with the real engine."""

import json
import re
import signal
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

import levelproof
from levelproof.experts.config import RECORD_STEPS, StopConfig
from levelproof.experts.search.config import SearchConfig
from levelproof.experts.witness.witness import replay, succeeds
from levelproof.levelgen.files.level_file import from_document, to_document, write_level_file
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.gallery.contender import Contender
from levelproof.pipeline.play import training
from levelproof.pipeline.play.open import level_to_play
from levelproof.pipeline.play.server import HOST, serving
from levelproof.pipeline.play.session import Session, empty_file
from levelproof.pipeline.store.manifest import require_manifest
from tests.experts.small import untouched
from tests.pace import patience
from tests.pipeline.command import assert_refused, heed_ctrl_c, here, line_of, start
from tests.pipeline.made import small_policy

ANSWER_SECONDS = 120  # s; limit for an answer
QUICK = replace(untouched(StopConfig()), search=SearchConfig(env_steps=65_536))


@pytest.fixture(scope="module")
def address(split: Path) -> Iterator[str]:
    """Address of a server whose level has a witness."""
    rows = require_manifest(split).table.to_pylist()
    solved = next(row for row in rows if row["shard"])
    file, actions = level_to_play(split, solved["level_id"], None)
    with serving(file, actions, QUICK, 20_000, 0) as server:
        yield f"http://{HOST}:{server.socket.getsockname()[1]}"


@pytest.fixture
def page(address: str) -> Iterator[ClientConnection]:
    with connected(address) as connection:
        yield connection


def connected(address: str, origin: str = "") -> ClientConnection:
    """Connect to the server at this address, from a page of `origin`, by default its own."""
    there, own = f"{address.replace('http', 'ws')}/socket", Origin(origin or address)
    return connect(there, origin=own, max_size=2**26, open_timeout=patience(10))


def ask(page: ClientConnection, request: str, /, **fields: Any) -> dict[str, Any]:
    page.send(json.dumps({"ask": request, "id": 1, **fields}))
    while "training" in (answer := json.loads(page.recv(patience(ANSWER_SECONDS)))):
        pass
    return answer


def test_command_serves_a_level_until_ctrl_c(split: Path, tmp_path: Path) -> None:
    data = levelproof.open(split, where="label = 'solved'")
    stored = data.read(np.arange(1), observation=None)
    witness = stored.action[0, : np.argmax(stored.done[0]) + 1]
    words = ["play", str(split), str(data.manifest["level_id"][0].as_py()), "--no-browser", "--port", "0"]
    process = start(words, tmp_path, preexec_fn=heed_ctrl_c)
    try:
        line = line_of(process, process.stdout)
        found = re.search(r"http://\S+:\d+", line)
        assert found, line
        with connected(found[0]) as page:
            assert ask(page, "play")["actions"] == witness.tolist()
            assert ask(page, "attempt")["actions"], "by the policy that comes with levelproof"
            process.send_signal(signal.SIGINT)  # while the page is open
            out, err = process.communicate(timeout=patience(ANSWER_SECONDS))
    finally:
        process.kill()
    assert (process.returncode, err) == (0, "")
    assert "Done." in out


def test_step_requests_reproduce_the_film(page: ClientConnection) -> None:
    film = ask(page, "play")
    assert ask(page, "restart")["places"] == film["places"][0]
    for step, action in enumerate(film["actions"], 1):
        moment = ask(page, "step", action=action)
        if step < len(film["actions"]):
            assert moment["places"] == film["places"][step]
            assert not moment["done"]
    assert moment["goal"]
    assert moment["timestep"] == len(film["actions"])
    assert ask(page, "step", action=[0] * 6)["timestep"] == 1  # a new episode


def test_save_writes_a_level_file_with_its_witness(page: ClientConnection, tmp_path: Path) -> None:
    document = ask(page, "save")["document"]
    path = tmp_path / "witness.json"
    path.write_text(json.dumps(document))
    file, actions = level_to_play(path, None, None)
    assert actions is not None
    assert actions.tolist() == document["witness"]["actions"]
    padded = np.zeros((RECORD_STEPS, 6, 1), int)
    padded[: len(actions), :, 0] = actions
    record = replay(file.level, padded, file.rules)
    assert succeeds(record.done[: len(actions)], record.goal[: len(actions)])[0]
    document["witness"]["actions"] = [[0] * 6] * 3  # these do not solve the level
    assert ask(page, "load", document=document)["witness"] is False


def test_edits_are_applied_undone_and_refused(page: ClientConnection) -> None:
    ask(page, "empty", size="m")
    level = ask(page, "edit", name="add_body", **{"with": ["circle", 1.0, 2.0]})
    body = ask(page, "at", x=1.0, y=2.0)["bodies"][0]
    assert body in level["bodies"]
    ask(page, "edit", name="set_role", **{"with": [body, 1]})
    green = from_document(ask(page, "save")["document"]).level
    assert green.role[body] == 1
    assert ask(page, "undo")["redo"]
    assert from_document(ask(page, "save")["document"]).level.role[body] == 0
    assert ask(page, "redo")["undo"]
    assert from_document(ask(page, "save")["document"]).level.role[body] == 1
    for name, values in (("delete", ["body", 0]), ("move", [body, 1e9, 0]), ("resize", [body, float("nan")])):
        assert ask(page, "edit", name=name, **{"with": values})["error"].endswith(".")
    for malformed in ({"ask": "__init__"}, {"ask": "edit"}, {"ask": "step", "action": [9] * 6}, {"ask": ["step"]}, {}):
        page.send(json.dumps(malformed))
        assert json.loads(page.recv(patience(ANSWER_SECONDS)))["error"].endswith(".")


@pytest.mark.campaign
def test_train_request_streams_progress(page: ClientConnection, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "ATTEMPT_INTERVAL", 0.0)
    assert "error" not in ask(page, "train")
    messages, end = [], time.monotonic() + patience(ANSWER_SECONDS)
    while not messages or messages[-1].get("stage") not in ("done", "failed"):
        assert time.monotonic() < end
        message = json.loads(page.recv(patience(ANSWER_SECONDS)))
        messages.append(message["training"])
    assert messages[-1]["label"] == "solved", messages[-1]
    assert any("curve" in message for message in messages)
    updates = [message for message in messages if "attempts" in message]
    assert all(len(update["attempts"]) == len(update["goals"]) == training.ATTEMPTS for update in updates)
    assert updates
    start, drawn = ask(page, "restart")["places"], np.array(updates[0]["attempts"])
    assert drawn.shape == (training.ATTEMPTS, training.SHOWN_STEPS, len(start))
    film = messages[-1]["film"]
    assert ask(page, "play")["actions"] == film["actions"]


@pytest.mark.slow
def test_policy_attempts_are_played_from_the_start(split: Path) -> None:
    """Another attempt each time; a success is the level's witness, as if the user had played it."""
    row = next(row for row in require_manifest(split).table.to_pylist() if row["shard"])
    file, _ = level_to_play(split, row["level_id"], None)
    session = Session(file, None, Contender(small_policy(), 1))
    assert session.level({})["policy"]
    films = [session.attempt({}) for _ in range(8)]
    assert len({json.dumps(film["actions"]) for film in films}) > 1
    for film in films:
        assert session.restart({})["places"] == film["places"][0]
        moments = [session.step({"action": action}) for action in film["actions"]]
        assert [moment["places"] for moment in moments] == film["places"][1:]
        assert [moment["done"] for moment in moments] == [False] * (len(moments) - 1) + [True]
        assert moments[-1]["goal"] == film["goal"]
    assert ("error" not in session.answer({"ask": "play"})) == any(film["goal"] for film in films)


@pytest.mark.parametrize("contender", [None, "of another size"])
def test_page_without_a_policy_for_its_level_says_so(contender: str | None) -> None:
    policy = Contender(small_policy(SIZES["s"]), 1) if contender else None
    session = Session(empty_file("m"), None, policy)
    assert not session.level({})["policy"]
    assert "--policy" in session.answer({"ask": "attempt"})["error"]


def test_server_refuses_other_origins_and_hosts(address: str) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        connected(address, origin="http://example.com")
    for path, host in (("/", "example.com"), ("/../session.py", ""), ("/nothing", "")):
        request = urllib.request.Request(address + path, headers={"Host": host} if host else {})
        with pytest.raises(urllib.error.HTTPError):
            urllib.request.urlopen(request, timeout=patience(10))
    for path in ("/", "/draw.js", "/curve.js", "/focus.js", "/palette.css", "/main.js"):
        assert urllib.request.urlopen(address + path, timeout=patience(10)).read()


def test_play_refuses_unplayable_arguments(split: Path, tmp_path: Path, address: str) -> None:
    assert_refused(here(["play", str(tmp_path / "none.json")], tmp_path), 2, "none.json")
    assert_refused(here(["play", str(split)], tmp_path), 2, "Add its id")
    assert_refused(here(["play", "--policy", "none"], tmp_path), 2, "There is no policy in none")
    done = here(["play", "--policy", "builtin:x"], tmp_path)
    assert_refused(done, 2, "no policy builtin:x", "comes with builtin:m, builtin:s")
    assert_refused(here(["play", "--size", "giant"], tmp_path), 2, "giant")
    assert_refused(here(["play", "--port", address.rpartition(":")[2]], tmp_path), 2, "--port")
    assert_refused(here(["play", "--port", "65536"], tmp_path), 2, "port 65536", "must be 0-65535", "--port")
    level = tmp_path / "level.json"
    write_level_file(empty_file("m"), level)
    with pytest.raises(UserError, match="leave out"):
        level_to_play(level, 1, None)
    assert level_to_play(level, None, None)[1] is None
    with pytest.raises(UserError, match="There is no split at"):
        level_to_play(tmp_path / "128k/x", None, None)


def test_file_opened_on_the_page_is_refused_as_on_the_command_line(page: ClientConnection, tmp_path: Path) -> None:
    document = {"env_state": {}}
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(document))
    with pytest.raises(UserError) as refused:
        level_to_play(path, None, None)
    assert ask(page, "load", name=str(path), document=document)["error"] == str(refused.value)


def test_level_whose_steps_take_minutes_is_refused(page: ClientConnection, tmp_path: Path) -> None:
    """Whether it is named or opened on the page, before its witness is replayed."""
    path, document = tmp_path / "level.json", to_document(empty_file("s"))
    document["static_env_params"]["frame_skip"] = 1_000_000
    document["witness"] = {"actions": [[0] * 6] * RECORD_STEPS}
    path.write_text(json.dumps(document))
    with pytest.raises(
        UserError, match="take 1,000,000 physics steps per env step, but the player allows at most 8: choose"
    ):
        level_to_play(path, None, None)
    assert "lower its frame_skip" in ask(page, "load", document=document)["error"]


def test_success_after_the_end_of_a_record_is_no_witness() -> None:
    """Rules of a file may let an episode go on for longer than a record."""
    file = empty_file("m")
    session = Session(replace(file, rules=replace(file.rules, max_timesteps=1000)))
    for name, *values in driven_by_a_thruster():
        assert "error" not in session.answer({"ask": "edit", "name": name, "with": values})
    for wait, kept in ((RECORD_STEPS, False), (0, True)):
        session.restart({})
        for _ in range(wait):
            assert not session.step({"action": [0] * 6})["done"]
        moment = {"done": False}
        while not moment["done"]:
            moment = session.step({"action": [0, 0, 0, 0, 1, 0]})
        assert (moment["goal"], moment["kept"]) == (True, kept)
        assert session.level({})["witness"] == kept


def test_what_is_attached_to_a_missing_body_is_not_listed() -> None:
    """The page does not draw it, and would give its place to what comes next."""
    session = Session(empty_file("m"))
    edits = [("add_body", "circle", x, 0.7) for x in (1.0, 1.2, 3.0)]
    for name, *values in (*edits, ("add_joint", 1.1, 0.7, False), *(("add_thruster", x, 0.7, 0.0) for x in (1.1, 3.0))):
        assert "error" not in session.answer({"ask": "edit", "name": name, "with": values}), name
    level = session.file.level
    assert [*session.level({})["joints"], *session.level({})["thrusters"]] == [0, 0, 1]
    active = level.model.active.copy()
    active[[level.model.joint_a[0, 0], level.model.thruster_body[0, 0]]] = False
    shown = Session(replace(session.file, level=replace(level, model=replace(level.model, active=active)))).level({})
    assert (shown["joints"], shown["thrusters"]) == ([], [1])


def driven_by_a_thruster() -> list[tuple[Any, ...]]:
    """Edits of an empty level of size m: a green circle whose thruster pushes it to a blue rectangle."""
    circle, rectangle = 6, 4
    return [
        ("add_body", "circle", 1.0, 0.7), ("set_role", circle, 1), ("add_body", "rectangle", 4.0, 0.7),
        ("set_role", rectangle, 2), ("fix", rectangle, True), ("add_thruster", 1.0, 0.7, 0.0),
    ]  # fmt: skip
