"""The flag that makes a library call its own functions: seen at work, and how wheels are written again."""

import base64
import csv
import ctypes
import hashlib
import os
import shutil
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from fake_wheels import fake_library, fake_wheel

from requirements.symbolic_wheel import main, with_symbolic_flag, write_symbolic_wheel

COMPILER = shutil.which("cc") or shutil.which("gcc")
needs_elf = pytest.mark.skipif(sys.platform != "linux" or not COMPILER, reason="needs Linux and a C compiler")


def compiled(folder: Path, name: str, source: str, *options: str) -> Path:
    code, library = folder / f"{name}.c", folder / f"lib{name}.so"
    code.write_text(source, encoding="utf-8")
    command = [COMPILER, "-shared", "-fPIC", "-O0", "-fno-builtin", *options, "-o", library, code]
    subprocess.run(command, check=True, timeout=600)
    return library


@needs_elf
def test_with_the_flag_a_library_calls_its_own_function_and_still_what_it_imports(tmp_path):
    """`version` is in the program as well, `shared` only there: that of the program has to be taken."""
    program = compiled(tmp_path, "program", "int version(void) { return 1; }\nint shared(void) { return 10; }\n")
    source = "int shared(void);\nint version(void) { return 2; }\nint answer(void) { return version() + shared(); }\n"
    plain = compiled(tmp_path, "plain", source, "-Wl,--enable-new-dtags,-rpath,/nowhere")
    symbolic = tmp_path / "libsymbolic.so"
    symbolic.write_bytes(with_symbolic_flag(plain.read_bytes(), "plain"))
    ctypes.CDLL(str(program), mode=os.RTLD_GLOBAL)
    assert ctypes.CDLL(str(plain)).answer() == 1 + 10
    assert ctypes.CDLL(str(symbolic)).answer() == 2 + 10


def test_the_flag_takes_the_place_of_the_search_path_and_nothing_else_changes():
    changed = with_symbolic_flag(fake_library(1, 29, 5), "x")
    assert changed == fake_library(1, 16, 5)[: 64 + 56 + 16] + struct.pack("<QQ", 16, 0) + fake_library(1, 16, 5)[-32:]
    assert with_symbolic_flag(changed, "x") == changed
    for content, complaint in ((b"MZ...", "no 64-bit"), (fake_library(1, 5), "no search path")):
        with pytest.raises(ValueError, match=f"thing.so: .*{complaint}"):
            with_symbolic_flag(content, "thing.so")


def test_a_wheel_is_whole_again_under_a_name_of_its_own(tmp_path):
    wheel = fake_wheel(tmp_path / "openexr-1.0-cp313-cp313-manylinux_2_28_x86_64.whl", fake_library(29))
    (tmp_path / "new").mkdir()
    written = write_symbolic_wheel(wheel, tmp_path / "new")
    assert written.name == "openexr-1.0-1-cp313-cp313-manylinux_2_28_x86_64.whl"
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(written) as new:
        contents = {name: new.read(name) for name in new.namelist()}
        assert contents.keys() == set(old.namelist()) and contents["Imath.py"] == old.read("Imath.py")
    assert contents["OpenEXR.cpython-313-x86_64-linux-gnu.so"] == with_symbolic_flag(fake_library(29), "x")
    assert contents["openexr-1.0.dist-info/WHEEL"].splitlines()[-1] == b"Build: 1"
    # The record of a wheel names each file with its hash and size, and itself with neither.
    record = contents.pop("openexr-1.0.dist-info/RECORD").decode().splitlines()
    rows = {name: rest for name, *rest in csv.reader(record)}
    assert rows.pop("openexr-1.0.dist-info/RECORD") == ["", ""]
    expected = {}
    for name, content in contents.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).decode().rstrip("=")
        expected[name] = [f"sha256={digest}", str(len(content))]
    assert rows == expected


def test_installed_libraries_are_changed_in_place(tmp_path):
    library, other = tmp_path / "OpenEXR.cpython-314-x86_64-linux-gnu.so", tmp_path / "other.so"
    for path in (library, other):
        path.write_bytes(fake_library(29))
    main(tmp_path)
    main(tmp_path)
    assert library.read_bytes() == with_symbolic_flag(fake_library(29), "x") and other.read_bytes() == fake_library(29)
    assert sorted(path.name for path in tmp_path.iterdir()) == [library.name, other.name]
