"""A bake that would not fit into memory is refused before Blender starts, with the number and what to change."""

import re

import pytest

from ltsh_addon import cli
from ltsh_addon.blender.process import client, memory
from ltsh_addon.pipeline.bake import BakeOptions, check_memory
from ltsh_addon.scene import SceneError

LIMIT = ["--memory-limit", "450M"]


@pytest.fixture
def room(tmp_path, monkeypatch):
    """A scene that must not be opened, on a machine of one core without limits of its own."""

    def refuse(*arguments):
        raise AssertionError("Blender was started")

    monkeypatch.setattr(client, "run_child", refuse)
    monkeypatch.delenv(memory.VARIABLE, raising=False)
    monkeypatch.setenv("LTSH_CORES", "1")
    path = tmp_path / "room.blend"
    path.write_bytes(b"BLENDER")
    return path


def refused(capsys, *arguments):
    """The one line that says why."""
    code = cli.main([str(argument) for argument in arguments])
    stdout, stderr = capsys.readouterr()
    (line,) = stderr.splitlines()
    assert (code, stdout) == (1, "") and "raise --memory-limit" in line
    return line


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ([], r"a bake of 1024x1024 texels takes about 5\d\d MiB of memory, 450 MiB may be used: reduce --size below"),
        (["--size", "8192", "--margin", "512"], r"8192x8192 texels takes about 7\d\d MiB .*: reduce --margin, or"),
        (["--error"], r"takes about 6\d\d MiB of memory"),
        (["--techniques", "ltc,ltsh2,ltsh4", "--passes", "specular,diffuse,combined"], r"takes about 6\d\d MiB"),
    ],
)
def test_too_large_bakes_are_refused(capsys, room, tmp_path, options, complaint):
    line = refused(capsys, "bake", room, "-o", tmp_path / "out", *LIMIT, "--frames", "1-9", "--quiet", *options)
    assert re.search(complaint, line) and list((tmp_path / "out").iterdir()) == []


def test_the_limit_of_the_environment_and_of_preferences_holds_for_bakes(capsys, room, tmp_path, monkeypatch):
    """Preferences of the extension set the variable for the processes that Blender starts."""
    monkeypatch.setenv(memory.VARIABLE, "450")
    assert "450 MiB may be used" in refused(capsys, "bake", room, "-o", tmp_path / "out", "--quiet")


def test_a_job_file_may_have_the_limit(capsys, room, tmp_path):
    job = '[defaults]\nmemory-limit = "450M"\n[[job]]\ncommand = "bake"\nscene = "room.blend"\noutput = "out"\n'
    (tmp_path / "job.toml").write_text(job, encoding="utf-8")
    assert "450 MiB may be used" in refused(capsys, "run", tmp_path / "job.toml", "--quiet")


def test_what_is_said_to_help_helps(room, tmp_path, monkeypatch):
    def needed(**changes):
        values = {"width": 4096, "height": 4096, "margin": 16, **changes}
        with pytest.raises(SceneError, match=r"takes about [\d.]+ [MG]iB") as raised:
            check_memory(BakeOptions(room, tmp_path, memory_mib=1, **values))
        number, unit = re.search(r"about ([\d.]+) ([MG])iB", str(raised.value)).groups()
        return float(number) * {"M": 1, "G": 1024}[unit]

    monkeypatch.setattr("ltsh_addon.pipeline.bake.cores", lambda: 8)
    whole, wide = needed(), needed(width=8192, height=8192, margin=512)
    assert needed(width=512, height=512) < whole and needed(width=256, height=256) < 0.5 * whole
    monkeypatch.setattr("ltsh_addon.pipeline.bake.cores", lambda: 1)
    assert needed() < 0.5 * whole
    assert needed(width=8192, height=8192, margin=16) < wide
    # A large bake takes little more than one of 1024 x 1024.
    assert needed(width=8192, height=8192) == needed(width=1024, height=1024)


def test_bakes_that_fit_go_on(room, tmp_path):
    check_memory(BakeOptions(room, tmp_path, memory_mib=600))
