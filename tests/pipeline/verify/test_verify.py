"""`examine` on forged splits with valid checksums: regenerated levels, labels and witnesses expose each forgery."""

import errno
import itertools
import shutil
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from levelproof.experts.labels import WITNESSED, Label, untrained
from levelproof.experts.verdict.before import PriorVerdicts, decide
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import Failure, StoreFailure
from levelproof.pipeline.exchange.seed import export_seed
from levelproof.pipeline.jobs import repair as repairing
from levelproof.pipeline.store import fragment, remote, requests
from levelproof.pipeline.store import shard as shards
from levelproof.pipeline.store.formats import VERSION_KEY
from levelproof.pipeline.store.job_note import note_job
from levelproof.pipeline.store.layout import JOB, MANIFEST, fragment_files, unit_name
from levelproof.pipeline.store.locks import only_writer
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest, write_index
from levelproof.pipeline.store.remote import INDEX
from levelproof.pipeline.store.seal import Piece, seal
from levelproof.pipeline.store.shard import Shard, write_shard
from levelproof.pipeline.verify import cores, evidence, fragments
from levelproof.pipeline.verify import seeds as seed_files
from levelproof.pipeline.verify import verify as verifying
from levelproof.pipeline.verify.findings import Findings
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.command import assert_refused, here
from tests.pipeline.made import honest_split, made_job, rewrite
from tests.pipeline.servers import files_of, serving
from tests.pipeline.verify.forged import UNIT, UNITS, Row, assert_reported, forge, rows_labelled


def neighbours(split: Path) -> tuple[Row, Row]:
    """Return adjacent rows of one shard."""
    rows = rows_labelled(split, *WITNESSED)
    return next((a, b) for a, b in itertools.pairwise(rows) if a["shard"] == b["shard"])


def exchange_worlds(split: Path, a: Row, b: Row) -> None:
    path = split / a["shard"]
    shard = Shard(path)
    order = np.arange(len(shard.level_ids))
    order[[a["row"], b["row"]]] = b["row"], a["row"]
    arrays = shard.read(order)
    shutil.rmtree(path)
    write_shard(path, shard.level_ids, arrays)
    forge(split)


def set_another_processor(row: Row) -> None:
    row["device"] = "cpu: of another kind"


def set_a_gpu(row: Row) -> None:
    row["device"] = "gpu: of some kind"


def raising(error: Exception) -> Callable[..., Any]:
    def fail(*_: Any, **__: Any) -> Any:
        raise error

    return fail


def test_examine_finds_nothing_wrong_in_an_honest_split(honest: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Witnesses of small shards are replayed together, in as few blocks as possible."""
    counts: list[int] = []
    counted = lambda level, action, rules: counts.append(action.shape[-1]) or replay(level, action, rules)
    monkeypatch.setattr(evidence, "replay", counted)
    findings = examine(honest)
    assert findings.sentences == []
    assert (findings.levels, findings.shards) == (UNIT * UNITS, len(read_manifest(honest).shards))
    assert findings.witnesses == findings.same_bits == len(rows_labelled(honest, *WITNESSED))
    assert counts == [findings.witnesses]


def test_examine_checks_a_split_on_a_web_server(split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A web server lists no files: `examine` checks those that fragments name."""
    monkeypatch.setattr(remote, "_cache", lambda: remote.PieceCache(tmp_path / "cache", 10**9))
    write_index(split)
    shard = split / sorted(read_manifest(split, ["shard"]).shards)[0]
    with serving(files_of(split.parent)) as server:
        findings = examine(Path(f"{server.url}/{split.name}"))
        assert findings.sentences == []
        assert findings.witnesses == findings.same_bits == len(rows_labelled(split, *WITNESSED))
        with (shard / "zarr.json").open("a") as file:
            file.write(" ")
        (sentence,) = examine(Path(f"{server.url}/{split.name}")).sentences
        assert f"{shard.name}/zarr.json is not what was committed" in sentence


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["split", "seeds", "web server"])
def test_examine_in_several_processes_finds_the_same(
    kind: str, split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A split has two rows that lie, and a shard whose bytes have changed."""
    seeds, solved = tmp_path / "levels.parquet", rows_labelled(split, Label.SOLVED)
    export_seed(split, None, seeds)
    liars, other = [solved[0]["level_id"], solved[1]["level_id"]], split / solved[-1]["shard"] / "zarr.json"
    forge(split, lambda row: row.update(steps_to_goal=256), liars)
    other.write_bytes(other.read_bytes() + b" ")
    write_index(split)
    with serving(files_of(split.parent)) as server:
        path = {"split": split, "seeds": seeds, "web server": Path(f"{server.url}/{split.name}")}[kind]
        alone = examine(path)
        monkeypatch.setattr(cores, "LEAST", 1)
        monkeypatch.setattr(cores, "own_cores", lambda: range(3))
        monkeypatch.setattr(verifying, "BLOCK", UNIT)
        monkeypatch.setattr(seed_files, "READ", UNIT)
        assert examine(path) == alone
    assert alone.levels == UNIT * UNITS
    assert len(alone.sentences) == (0 if kind == "seeds" else 3)


def test_examine_compares_the_index_for_web_servers_with_the_fragments(split: Path) -> None:
    write_index(split)
    index = split / MANIFEST / INDEX
    whole = index.read_bytes()
    cut = whole[: whole.index(b"\n") + 1]
    for content, differs in (whole, False), (cut, True), (whole.replace(b"1", b"2", 1), True):
        index.write_bytes(content)
        verifying._check_index(split, findings := Findings())
        assert bool(findings.wrong) == differs
    assert_reported(split, f"The index {index} differs from the fragments there: `levelproof seal` writes it anew")


@pytest.mark.slow
def test_examine_reports_a_failing_server_as_such_and_not_as_damage(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever request fails."""
    write_index(split)
    monkeypatch.setitem(requests.RETRIES, "retry_timeout", timedelta(seconds=0.2))
    remote._store.cache_clear()
    with serving(files_of(split.parent)) as server:
        for share in (1.0, 0.3, 0.5, 0.7, 0.95):
            cache = remote.PieceCache(tmp_path / str(share), 10**9)
            monkeypatch.setattr(remote, "_cache", lambda cache=cache: cache)
            if share == 1.0:
                assert not examine(Path(f"{server.url}/{split.name}")).sentences
                asked = server.count
                continue
            last = server.count + share * asked
            server.meanwhile = lambda number, last=last: server.spoil(int(number > last))
            with pytest.raises(StoreFailure, match="503"):
                examine(Path(f"{server.url}/{split.name}"))
            server.spoil(0)


def test_examine_finds_nothing_wrong_in_a_split_that_is_sealed_meanwhile(
    split: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each look, a run merges two fragments after they were listed and before they are read."""
    groups, sealed = verifying.grouped, list[Path]()

    def merging(*listed: Any) -> Iterator[Any]:
        pieces = list(map(Piece.of, read_manifest(split, []).fragments))
        sealed.extend([seal(split, pieces[:2]).path] if pieces[1:] else [])
        return groups(*listed)

    levels = read_manifest(split, []).level_ids.tolist()
    monkeypatch.setattr(verifying, "GROUP_ROWS", 1)
    monkeypatch.setattr(verifying, "grouped", merging)
    with only_writer(split, print):
        findings = examine(split)
    assert findings.sentences == []
    assert findings.levels == len(levels)
    assert len(sealed) == UNITS - 1 > 2
    assert findings.examined == fragment_files(split)


@pytest.mark.parametrize("adapts", [False, True])
@pytest.mark.parametrize("elsewhere", [False, True])
def test_examine_finds_exchanged_worlds(split: Path, adapts: bool, elsewhere: bool) -> None:
    """With or without exchanged rows, and whether or not the rows claim to be of a GPU, whose bits differ."""
    a, b = neighbours(split)
    exchange_worlds(split, a, b)
    if adapts:
        for row, other in ((a, b), (b, a)):
            position = {name: row[name] for name in ("level_id", "row", "shard")}
            forge(split, lambda changed, new=other | position: changed.update(new), [row["level_id"]])
    if elsewhere:
        forge(split, set_a_gpu)
    what = "a content hash or a signature that differs" if adapts else "a world in its shard that differs"
    assert_reported(split, *sorted(f"Level {row['level_id']} has {what}" for row in (a, b)))


@pytest.mark.parametrize("label", [Label.SOLVED, Label.UNSOLVED, Label.TRIVIAL])
@pytest.mark.parametrize("elsewhere", [False, True])
def test_examine_finds_a_row_relabelled_unsolvable(split: Path, label: Label, elsewhere: bool) -> None:
    level_id = rows_labelled(split, label)[0]["level_id"]
    reason = rows_labelled(split, Label.UNSOLVABLE)[0]["label_reason"]
    change = {"label": "unsolvable", "label_reason": reason, "shard": None, "row": None, "steps_to_goal": None}
    forge(split, lambda row: row.update(change), [level_id])
    if elsewhere:
        forge(split, set_a_gpu)
    proper = "should be trivial" if label is Label.TRIVIAL else "nothing proves that"
    assert_reported(split, f"Level {level_id} is unsolvable, but {proper}.")


@pytest.mark.parametrize(("label", "other"), [("unsolvable", "unsolved"), ("trivial", "solved")])
@pytest.mark.parametrize("elsewhere", [False, True])
def test_examine_finds_a_label_that_hides_a_proof(split: Path, label: str, other: str, elsewhere: bool) -> None:
    level_id = rows_labelled(split, Label(label))[0]["level_id"]
    forge(split, lambda row: row.update(label=other), [level_id])
    sentences = [f"Level {level_id} is {other}, but should be {label}."]
    if elsewhere:
        forge(split, set_a_gpu)
    assert_reported(split, *sentences * (label == "unsolvable" or not elsewhere))


def test_examine_accepts_what_doing_nothing_does_on_a_gpu(split: Path) -> None:
    """Chaotic idle episodes end differently on another engine or GPU."""
    level_id = rows_labelled(split, Label.SOLVED)[0]["level_id"]
    forge(split, lambda row: row.update(failed_by_noop=not row["failed_by_noop"]), [level_id])
    assert_reported(split, "by doing nothing, but the manifest says otherwise")
    forge(split, set_a_gpu)
    assert_reported(split)


def test_examine_believes_a_witness_rather_than_a_proof(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as imported actions that solve a level wrongly proved unsolvable."""
    wrong = untrained(Label.UNSOLVABLE, "wrongly proved", False)

    def all_unsolvable(levels: Level, rules: TaskParams) -> PriorVerdicts:
        verdicts, failed = decide(levels, rules)
        return PriorVerdicts([verdict or wrong for verdict in verdicts], failed)

    monkeypatch.setattr(evidence, "decide", all_unsolvable)
    unsolved = rows_labelled(split, Label.UNSOLVED)
    sentences = sorted(f"Level {row['level_id']} is unsolved, but should be unsolvable." for row in unsolved)
    assert sorted(examine(split).sentences) == sentences


def test_examine_finds_exchanged_identities(split: Path) -> None:
    a, b = rows_labelled(split, Label.UNSOLVED)[:2]
    for row, other, name in ((a, b, "content_hash"), (b, a, "signature")):
        forge(split, lambda changed, name=name, other=other: changed.update({name: other[name]}), [row["level_id"]])
    sentence = "Level {} has a content hash or a signature that differs from the level that its id makes."
    assert_reported(split, *sorted(sentence.format(row["level_id"]) for row in (a, b)))


def test_examine_finds_a_content_hash_that_only_a_gpus_row_claims(split: Path) -> None:
    a, _ = neighbours(split)
    forge(split, lambda row: row.update(content_hash=f"c1:{'0' * 32}") or set_a_gpu(row), [a["level_id"]])
    assert_reported(split, f"Level {a['level_id']} has a world in its shard that differs from its content hash")


def test_examine_finds_other_false_columns(split: Path) -> None:
    solved, trivial, unsolved = (
        rows_labelled(split, label)[0] for label in (Label.SOLVED, Label.TRIVIAL, Label.UNSOLVED)
    )
    forge(split, lambda row: row.update(steps_to_goal=row["steps_to_goal"] + 1), [solved["level_id"]])
    forge(split, lambda row: row.update(label_reason="a feeling"), [trivial["level_id"]])
    forge(split, lambda row: row.update(failed_by_noop=not row["failed_by_noop"]), [unsolved["level_id"]])
    last = rows_labelled(split, Label.UNSOLVED)[-1]["level_id"]
    forge(split, lambda row: row.update(size="m"), [last])
    sentences = {
        solved["level_id"]: "reaches the goal in ",
        trivial["level_id"]: "is trivial, but not for the reason in its row",
        unsolved["level_id"]: "by doing nothing, but the manifest says otherwise",
        last: "has size m, but its split has s",
    }
    assert_reported(split, *(sentences[i] for i in sorted(sentences, key=lambda i: f"Level {i} ")))


def test_examine_finds_rows_that_name_another_levels_position(split: Path) -> None:
    a, b = neighbours(split)
    forge(split, lambda row: row.update(row=b["row"]), [a["level_id"]])
    assert_reported(
        split, f"Level {a['level_id']} should be in row {b['row']} of {a['shard']}, which has level {b['level_id']}"
    )
    forge(split, lambda row: row.update(row=10**6), [a["level_id"]])
    assert_reported(split, "which has level None there")


def test_examine_finds_a_record_that_differs_in_one_bit(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On any CPU if one made it, and on the GPU that made it."""
    row = rows_labelled(split, Label.SOLVED)[0]
    shard = Shard(split / row["shard"])
    arrays = shard.read()
    arrays["record/reward"].view(np.uint32)[7, row["row"]] ^= 1
    shutil.rmtree(shard.path)
    write_shard(shard.path, shard.level_ids, arrays)
    forge(split)
    assert_reported(split, f"Level {row['level_id']} has a witness that does not replay: its reward differs.")
    forge(split, set_another_processor)
    assert_reported(split, f"Level {row['level_id']} has a witness that does not replay: its reward differs.")
    forge(split, set_a_gpu)
    assert_reported(split)
    monkeypatch.setattr(evidence, "device", lambda: "gpu: of some kind")
    assert_reported(split, f"Level {row['level_id']} has a witness that does not replay: its reward differs.")


def test_examine_bounds_the_lost_levels_of_a_damaged_fragment(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever range the fragment's name and the note claim."""
    monkeypatch.setattr("levelproof.pipeline.verify.verify.MAX_ROWS", 100)
    (split / MANIFEST / f"{unit_name(0, MAX_LEVEL_ID)}.parquet").write_bytes(b"PAR1")
    assert len(examine(split).lost) <= 102
    note_job(split, made_job(), ["levelproof", "generate"], [(0, MAX_LEVEL_ID)])
    assert len(examine(split).lost) <= 102


@pytest.mark.parametrize(
    "error", [OSError(errno.EIO, "Input/output error"), PermissionError(errno.EACCES, "no"), MemoryError()]
)
@pytest.mark.parametrize("step", ["has_own", "read_fragment", "digests_of", "open_shard", JOB])
def test_repair_removes_nothing_that_it_cannot_read(
    split: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, step: str
) -> None:
    """Whether a fragment, a shard or the note cannot be read, and why."""
    before = {path: path.stat().st_ino for path in split.rglob("*")}
    failing = raising(error)
    if step == "read_fragment":
        monkeypatch.setattr(fragment, "bounded", failing)
    elif step == "open_shard":
        monkeypatch.setattr(shards, "read_whole", failing)
    elif step == JOB:
        read = Path.read_bytes
        monkeypatch.setattr(Path, "read_bytes", lambda path: failing() if path.name == JOB else read(path))
    else:
        monkeypatch.setattr(fragments if step == "has_own" else verifying, step, failing)
    done = here(["verify", str(split), "--repair", "executor=inline"], split.parent)
    assert_refused(done, 1, str(split), "run the same command again" if step != "read_fragment" else "")
    assert {path: path.stat().st_ino for path in split.rglob("*")} == before


def test_repair_removes_no_shard_of_another_version(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {path: path.stat().st_ino for path in split.rglob("*")}
    monkeypatch.setattr(shards, "SHARD_VERSION", "another")
    done = here(["verify", str(split), "--repair", "executor=inline"], split.parent)
    assert_refused(done, 1, str(split), "use the levelproof that wrote it")
    assert {path: path.stat().st_ino for path in split.rglob("*")} == before


def test_repair_removes_no_fragment_of_another_version(split: Path) -> None:
    path = fragment_paths(split)[0]
    rewrite(path, pq.read_table(path), {VERSION_KEY: b"99"}, write_page_checksum=True)
    done = here(["verify", str(split), "--repair", "executor=inline"], split.parent)
    assert_refused(done, 1, str(path), "has manifest version 99", "use the levelproof that wrote it")
    assert path.exists()


def test_repair_is_refused_at_once_while_another_command_writes(split: Path) -> None:
    with only_writer(split, print):
        done = here(["verify", str(split), "--repair", "executor=inline"], split.parent)
    assert_refused(done, 2, f"Another levelproof command is writing to {split}")
    assert not done.stdout


def test_repair_does_not_act_on_what_has_changed_since(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another command replaces a damaged fragment, or seals, between the examination and the lock."""
    damaged, examined = fragment_paths(split)[0], repairing._examine_split
    whole = damaged.read_bytes()

    def meanwhile(*args: Any, **how: Any) -> Any:
        findings = examined(*args, **how)
        (split / "new").write_bytes(whole)
        (split / "new").replace(damaged)
        return findings

    damaged.write_bytes(b"PAR1")
    monkeypatch.setattr(repairing, "_examine_split", meanwhile)
    done = here(["verify", str(split), "--repair", "executor=inline"], split.parent)
    assert_refused(
        done, 1, f"Another command has changed {split} since it was examined: once it has ended, run this one again"
    )
    assert damaged.read_bytes() == whole
    assert not examine(split).wrong


def test_repair_stores_as_the_noted_command_if_no_fragment_is_left(split: Path) -> None:
    how = ["density=witness", "key_every=16", "keep_experts=true"]
    note_job(split, made_job(str(split.parent), *how), ["levelproof", "generate", "levels=8", *how], [(0, 7)])
    for path in fragment_paths(split):
        path.write_bytes(b"PAR1")
    job = repairing._job(split, examine(split), [])
    assert (job.stored, job.keep_experts) == ("density=witness key_every=16", True)
    verify = ["verify", str(split)]
    assert here(verify, split).stdout.endswith(f"Next:  levelproof verify {split} --repair\n")
    (split / JOB).unlink()
    assert "Next:" not in here(verify, split).stdout, "nothing says what to make"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [(None, "are lost"), ({"size": "huge"}, "does not accept"), ({"sampler_version": 99}, "with other settings")],
)
def test_repair_refuses_settings_that_would_make_other_levels(
    split: Path, changes: dict[str, Any] | None, sentence: str
) -> None:
    config = None if changes is None else made_job().results | changes
    with pytest.raises(Failure, match=sentence):
        repairing._job(split, Findings(config=config), [])


def test_repair_keeps_experts_that_rows_name_if_no_file_is_left(tmp_path: Path) -> None:
    split = honest_split(tmp_path, 4, 1, experts=True)
    assert repairing._job(split, examine(split), []).keep_experts
    shutil.rmtree(split / "experts")
    assert repairing._job(split, examine(split), []).keep_experts
    assert not repairing._job(
        honest_split(tmp_path / "without", 4, 1), Findings(config=made_job().results), []
    ).keep_experts


def test_examine_reports_a_hostile_shard_once_and_checks_the_others(split: Path) -> None:
    row = rows_labelled(split, Label.SOLVED)[0]
    shard = Shard(split / row["shard"])
    arrays = shard.read()
    arrays["level/model/joint_a"][:] = 200
    shutil.rmtree(shard.path)
    write_shard(shard.path, shard.level_ids, arrays)
    forge(split)
    findings = examine(split)
    (sentence,) = findings.sentences
    assert "its field level/model/joint_a has numbers that size s cannot have" in sentence
    assert 0 < findings.witnesses == len(rows_labelled(split, *WITNESSED)) - len(shard.level_ids)
    for name in ("/etc", "../../elsewhere"):
        forge(split, lambda row, name=name: row.update(shard=name), [row["level_id"]])
        assert any(
            sentence.startswith(f"The manifest of {split} names {name!r}") for sentence in examine(split).sentences
        )
    shutil.rmtree(split / "shards")
    forge(split, lambda row: row.update(shard=shard.path.relative_to(split).as_posix()), [row["level_id"]])
    assert any(sentence.startswith("The shard ") for sentence in examine(split).sentences)
