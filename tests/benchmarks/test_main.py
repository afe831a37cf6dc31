"""The parser of benchmarks, and the report in its three forms."""

import argparse
import dataclasses
import json

import numpy as np
import pytest

from benchmarks import __main__ as command
from benchmarks.report import Report, Run, Table, as_json, as_page, as_text
from levelproof.pipeline.errors import Exit

REPORT = Report(
    title="A race",
    results=[{"size": "s", "ours": 123456.789, "reference": np.inf, "ratio": float("nan"), "runs": [1 / 3]}],
    tables=[Table(("size", "ours"), [("s", "123,457")], "Env steps/s")],
    notes=["lanes 8"],
    reference={"jax": "0.9.0"},
)
RUN = Run("physics", "python -m benchmarks physics", "2026-01-01", {"device": "cpu: x", "cores": 2, "system": "y"}, {})


class TestReport:
    def test_json_has_results_machine_and_versions(self) -> None:
        document = json.loads(as_json(REPORT, Run.now("physics", ["physics", "--json"], REPORT)))
        assert document["bench"] == "physics"
        assert (document["ours"], document["reference"], document["ratio"], document["runs"]) == (
            123460.0,
            "inf",
            None,
            [0.33333],
        )
        assert document["versions"]["reference"] == {"jax": "0.9.0"}
        assert set(document["machine"]) == {"device", "cores", "system"}
        assert document["date"].startswith("20")

    def test_json_has_a_document_per_result(self) -> None:
        twice = dataclasses.replace(REPORT, results=[{"size": "s"}, {"size": "m"}])
        first, end = json.JSONDecoder().raw_decode(text := as_json(twice, RUN))
        assert first["size"] == "s"
        assert json.loads(text[end:])["size"] == "m"

    def test_text_and_page_show_tables_and_notes(self) -> None:
        table = "Env steps/s:\n\n| size | ours |\n| --- | --- |\n| s | 123,457 |"
        assert as_text(REPORT, RUN).startswith(f"{table}\n\nlanes 8\n\n2026-01-01, on cpu: x, 2 cores, y")
        page = as_page(REPORT, RUN)
        assert page.startswith("# A race\n\nWritten by `python -m benchmarks physics`. Measured: 2026-01-01, on cpu: x")
        assert table in page
        assert "Measured: elsewhere." in as_page(dataclasses.replace(REPORT, made="elsewhere"), RUN)


class TestParser:
    @pytest.mark.parametrize("name", command.BENCHMARKS)
    def test_every_benchmark_shows_help(self, name, capsys) -> None:
        with pytest.raises(SystemExit) as error:
            command.main([name, "--help"])
        assert error.value.code == 0
        shown = capsys.readouterr().out
        assert f"python -m benchmarks {name}" in shown
        assert "--json" in shown
        assert "--write" in shown

    def test_help_lists_all_benchmarks(self, capsys) -> None:
        with pytest.raises(SystemExit):
            command.main(["--help"])
        shown = capsys.readouterr().out
        assert all(name in shown for name in command.BENCHMARKS)

    @pytest.mark.parametrize("arguments", [[], ["storm"], ["physics", "--size", "xl"], ["physics", "--lanes", "many"]])
    def test_parser_rejects_unknown_arguments(self, arguments) -> None:
        with pytest.raises(SystemExit) as error:
            command.main(arguments)
        assert error.value.code == Exit.INPUT


def test_show_overwrites_the_page_and_plots(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(command, "RESULTS", tmp_path / "results")
    args = argparse.Namespace(json=False, write=True, benchmark="physics")
    drawn = dataclasses.replace(
        REPORT, plots={"physics.svg": lambda path: path.write_text("<svg/>")}, fault="It is off."
    )
    for _ in range(2):
        command.show(drawn, RUN, args)
    assert (tmp_path / "results" / "physics.md").read_text() == as_page(drawn, RUN)
    assert (tmp_path / "results" / "physics.svg").read_text() == "<svg/>"
    shown = capsys.readouterr()
    assert "123,457" in shown.out
    assert shown.err.endswith("Error: It is off.\n")
