"""`python -m tables`: what it prints and how it ends."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ltsh_addon.shading import load_table
from tables import __main__

ROOT = Path(__file__).resolve().parents[2]

WRONG = [
    ([], "required: fit|validate|optimum|plot|export"),
    (["polish"], "invalid choice: 'polish'"),
    (["fit", "ltsh9"], "table 'ltsh9' is unknown, expected ltc"),
    (["fit", "ltsh2+ltc"], "a sum of two lobes cannot be fitted"),
    (["fit", "--size"], "expected one argument"),
    (["fit", "--size", "3"], "size is '3', expected a whole number of at least 4"),
    (["fit", "--jobs", "0"], "number of jobs is '0', expected a whole number of at least 1"),
    (["fit", "--brdf", "phong"], "invalid choice: 'phong'"),
]


@pytest.mark.parametrize("arguments, message", WRONG)
def test_bad_arguments_end_with_2(arguments, message, capsys):
    with pytest.raises(SystemExit) as caught:
        __main__.main(arguments)
    assert caught.value.code == 2
    streams = capsys.readouterr()
    assert streams.out == "" and message in streams.err and "usage: python -m tables" in streams.err


def run(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-m", "tables", *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, **options
    )


@pytest.mark.soak
def test_fitting_writes_tables_that_validate_measures(tmp_path):
    """Two coarse tables at a time, one of another BRDF; then all figures of both, as JSON and as text."""
    done = run("fit", "ltsh1", "ltc", "-o", tmp_path / "new", "--size", 4, "--brdf", "beckmann")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "" and "ltsh1 fitted in" in done.stderr and "ltc fitted in" in done.stderr
    paths = [tmp_path / "new" / f"beckmann_{name}.npz" for name in ("ltc", "ltsh1")]
    assert sorted((tmp_path / "new").iterdir()) == paths
    assert load_table(paths[1]).metadata["command"].endswith("tables fit ltsh1 --brdf beckmann --size 4")
    arguments = ["validate", *paths, "--count", 4]
    found = json.loads(run(*arguments, "--json").stdout)
    assert list(found) == [str(path) for path in paths]
    figures = found[str(paths[0])]
    assert 0.0 < figures["median"] <= figures["maximum"] and figures["albedo_mean"] > 0.0
    assert figures["lowest_albedo"] > 0.5 and len(figures["fresnel_basis"]) > 5
    text = run(*arguments).stdout
    assert f"{figures['mean']:.4f}" in text and text.count(str(paths[0])) == 2


@pytest.mark.soak
def test_the_same_command_gives_the_same_bytes(tmp_path):
    for folder in ("first", "second"):
        assert run("fit", "ltsh1", "-o", tmp_path / folder, "--size", 4).returncode == 0
    assert (tmp_path / "first" / "ltsh1.npz").read_bytes() == (tmp_path / "second" / "ltsh1.npz").read_bytes()


def test_a_folder_that_cannot_be_written_ends_with_1(tmp_path):
    (tmp_path / "file").write_text("")
    done = run("fit", "ltc", "-o", tmp_path / "file")
    assert done.returncode == 1 and done.stdout == ""
    assert str(tmp_path / "file") in done.stderr and "Traceback" not in done.stderr


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_an_interrupted_fit_leaves_no_child_and_can_go_on(tmp_path):
    """Interrupt as from a terminal: the whole group gets the signal. What is left is the state of the fit alone."""
    arguments = [sys.executable, "-m", "tables", "fit", "ltsh4", "-o", str(tmp_path), "--size", "24"]
    fit = subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True)
    deadline = time.monotonic() + 120.0
    while not list(tmp_path.glob("*.progress")) and time.monotonic() < deadline:
        time.sleep(0.1)
    os.killpg(fit.pid, signal.SIGINT)
    _, errors = fit.communicate(timeout=600)
    assert fit.returncode == 130 and "goes on from here" in errors and "Traceback" not in errors
    with pytest.raises(ProcessLookupError):
        os.killpg(fit.pid, 0)
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".part"] == ["ltsh4.progress"]


def test_a_table_that_cannot_be_read_ends_with_1(tmp_path, capsys):
    (tmp_path / "broken.npz").write_text("")
    assert __main__.main(["validate", str(tmp_path / "broken.npz")]) == 1
    streams = capsys.readouterr()
    assert streams.out == "" and f"{tmp_path / 'broken.npz'}: is no .npz" in streams.err
