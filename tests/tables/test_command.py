"""`python -m tables`: what it prints and how it ends."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ltsh_addon.shading import TableError
from tables import __main__ as command
from tables import validate

ROOT = Path(__file__).resolve().parents[2]
STATISTICS = validate.TableStatistics(*np.linspace(0.1, 0.8, 8).tolist())


WRONG = [[], ["polish"], ["fit", "ltsh9"], ["validate", "ltc", "nonsense"], ["fit", "--size"]]


@pytest.mark.parametrize("arguments", WRONG)
def test_bad_arguments_end_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        command.main(arguments)
    assert caught.value.code == 2
    streams = capsys.readouterr()
    assert streams.out == "" and "usage: ltsh tables" in streams.err


def test_the_module_can_be_run():
    done = subprocess.run([sys.executable, "-m", "tables", "fit", "ltsh9"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "table 'ltsh9' is unknown, expected some of ltc, ltsh2, ltsh4" in done.stderr


def test_validate_prints_one_json_document_per_table(monkeypatch, capsys):
    monkeypatch.setattr(validate, "validate", lambda table: STATISTICS)
    assert command.main(["validate", "ltsh2", "ltc"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [list(line) for line in lines] == [["ltsh2"], ["ltc"]]
    assert lines[0]["ltsh2"]["mean"] == pytest.approx(0.1)


def test_a_table_that_cannot_be_read_ends_with_1(monkeypatch, capsys):
    def broken(name):
        raise TableError(f"lookup table {name}: broken")

    monkeypatch.setattr(command, "load_table", broken)
    assert command.main(["validate", "ltc"]) == 1
    streams = capsys.readouterr()
    assert streams.out == "" and "lookup table ltc: broken" in streams.err
