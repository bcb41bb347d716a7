"""Files of others: what they may hold, what they must have, and that both are said in a few words."""

import io
import json
import zipfile

import numpy as np
import pytest

from ltsh_addon import reading
from ltsh_addon.reading import NUMBER, Malformed, check, file_name, read_arrays, read_json, read_toml, some

SHAPE = {
    "name": str,
    "size?": int | None,
    "rows": some([{"error": NUMBER, str: bool}]),
    "kind?": ("a", "b"),
    "file?": file_name,
}
WHOLE = {"name": "x", "size": None, "rows": [{"error": 1, "new": True}, {"error": 0.5}], "kind": "b", "file": "a/b"}


def test_what_has_the_shape_is_taken_with_whatever_else_it_has():
    check(WHOLE, SHAPE)
    check({"name": "", "rows": [{"error": -1}], "more": object()}, SHAPE)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"name": 3}, "name is 3, expected text"),
        ({"name": None}, "name is None, expected text"),
        ({"size": True}, "size is True, expected a whole number or nothing"),
        ({"size": 1.0}, "size is 1.0, expected a whole number or nothing"),
        ({"rows": []}, "rows is empty"),
        ({"rows": {}}, "rows is {}, expected a list"),
        ({"rows": [{"error": 1}, 3]}, r"rows\[1\] is 3, expected a table"),
        ({"rows": [{}]}, r"rows\[0\] has no 'error'"),
        ({"rows": [{"error": True}]}, r"rows\[0\].error is True, expected a number"),
        ({"rows": [{"error": 1, "new": 1}]}, r"rows\[0\].new is 1, expected true or false"),
        ({"kind": "c"}, "kind is 'c', expected 'a' or 'b'"),
        ({"kind": []}, r"kind is \[\], expected 'a' or 'b'"),
        *(
            ({"file": name}, "file is .*, expected a name below the folder")
            for name in ("", "/a", "../a", "a/../b", "a\0")
        ),
        ({"name": ["x" * 999]}, r"name is \['x{28} \.\.\. x{28}'\], expected text"),
    ],
)
def test_what_has_not_is_named_with_its_place(change, complaint):
    with pytest.raises(Malformed, match=f"^{complaint}$"):
        check(WHOLE | change, SHAPE)


def test_a_missing_key_is_named():
    for name in ("name", "rows"):
        with pytest.raises(Malformed, match=f"^the document has no '{name}'$"):
            check({key: value for key, value in WHOLE.items() if key != name}, SHAPE)
    for value in (None, 3, [], "x"):
        with pytest.raises(Malformed, match="^the document is .*, expected a table$"):
            check(value, SHAPE)


LEVELS = reading.MOST_LEVELS


@pytest.mark.parametrize(
    ("kind", "content", "complaint"),
    [
        *((kind, b"[" * 100_000, "more than 32 lists or tables|is no TOML") for kind in ("json", "toml")),
        ("json", b'{"a":' * LEVELS + b"{}" + b"}" * LEVELS, "more than 32 lists"),
        ("json", b"[0," + b"0," * reading.MOST_COMMAS + b"0]", "more than 4000000 values"),
        ("json", b" " * (reading.MOST_JSON + 1), "more than 128 MiB"),
        ("json", b'{"a": 9223372036854775808}', "does not fit into 64 bits"),
        ("json", b"9" * 5000, "is no JSON: Exceeds the limit"),
        ("json", b'{"a": NaN}', "is no JSON: NaN is no number"),
        ("json", b'{"a": "\\udc00"}', "no Unicode"),
        ("json", b'{"a": "\\udcc3\\udca9"}', "no Unicode"),  # as file names have them that are not decoded
        ("json", b'{"a": "\xff"}', "is no text in UTF-8"),
        ("json", b"", "is no JSON"),
        ("json", b"[]", r"the document is \[\], expected a table"),
        ("toml", b" " * (reading.MOST_TOML + 1), "more than 1 MiB"),
        ("toml", b"a = " + b"{a = " * LEVELS + b"1" + b"}" * LEVELS, "more than 32 lists"),
        ("toml", b"." .join([b"a"] * 33) + b" = 1", "a key has more than 32 parts"),
        ("toml", b"x = 1\n[ " + b" . ".join([b"a"] * 33) + b" ]", "a key has more than 32 parts"),
        ("toml", b"x = {y = 1, " + b".".join([b'"\\"a"'] * 33) + b" = 1}", "a key has more than 32 parts"),
        ("toml", b"a = 0x8000000000000000", "does not fit into 64 bits"),
        ("toml", b"a = " + b"9" * 5000, "is no TOML: Exceeds the limit"),
    ],
)  # fmt: skip
def test_what_is_too_much_is_refused(tmp_path, kind, content, complaint):
    (tmp_path / "x").write_bytes(content)
    with pytest.raises(Malformed, match=complaint):
        {"json": read_json, "toml": read_toml}[kind](tmp_path / "x")


def test_what_is_nearly_too_much_is_read(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b'\xef\xbb\xbf{"a":' + b"[" * (LEVELS - 1) + b"]" * (LEVELS - 1) + b', "b": -9223372036854775808}')
    assert read_json(path)["b"] == -(2**63)
    path.write_text(json.dumps({"a": "🦆ä"}), encoding="ascii")  # two halves for the duck
    assert read_json(path) == {"a": "🦆ä"}
    key = ".".join("a" * 31)
    text = f"\ufeff{key} = 1\r\n[b]\r\nname = \"{'a.' * 99}\"\r\nother = '''\r\nx = {'a.' * 99}''' # {'a.' * 99}\r\n"
    path.write_bytes(text.encode())
    assert read_toml(path)["b"]["name"] == "a." * 99


@pytest.mark.parametrize("read", [read_json, read_toml, lambda path: read_arrays(path, ["a"])])
def test_what_is_no_file_is_refused_and_what_is_missing_is_an_os_error(tmp_path, read):
    with pytest.raises(Malformed, match="^is a folder, expected a file$"):
        read(tmp_path)
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "none")


ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "b": np.array("text"), "c": np.zeros((2, 0)), "d": np.array(3, ">i2")}


def test_long_names_are_shortened():
    with pytest.raises(Malformed) as error:
        reading.check({"a" * 5000: {}}, {str: {"b" * 5000: int}})
    assert len(str(error.value)) < 200


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_are_read_as_numpy_reads_them(tmp_path, save):
    save(tmp_path / "x.npz", **ARRAYS, f=np.asfortranarray(ARRAYS["a"]))
    found = read_arrays(tmp_path / "x.npz", [*ARRAYS, "f"])
    for name, array in {**ARRAYS, "f": ARRAYS["a"]}.items():
        assert found[name].shape == array.shape and (found[name] == array).all(), name
    with pytest.raises(Malformed, match="has no 'z'"):
        read_arrays(tmp_path / "x.npz", ["z"])


def entry(shape, descr="<f4", size=24):
    stream = io.BytesIO()
    np.lib.format.write_array_header_2_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue() + bytes(size)


@pytest.mark.parametrize(
    ("content", "method", "complaint"),
    [
        (entry((16384, 16384, 3)), zipfile.ZIP_STORED, "a has shape .16384, 16384, 3. of float32, but 24 bytes"),
        (entry((2**62, 2**62)), zipfile.ZIP_STORED, "but 24 bytes"),
        (entry((-2, -3)), zipfile.ZIP_STORED, "a has shape .-2, -3. of float32"),
        (entry((5,)), zipfile.ZIP_STORED, "a has shape .5,. of float32, but 24 bytes"),
        (entry((1,), "|O", 8), zipfile.ZIP_STORED, "a holds Python objects"),
        (b"", zipfile.ZIP_STORED, "is no .npz: EOF"),
        (b"\x93NUMPY\x09\x00" + bytes(99), zipfile.ZIP_STORED, "is no .npz"),
        (entry((65 << 18,), size=65 << 20), zipfile.ZIP_DEFLATED, "holds 65 MiB of arrays, expected at most 64 MiB"),
        (entry((6,)), zipfile.ZIP_LZMA, "packed in a way that is not read"),
    ],
)
def test_arrays_that_are_not_what_they_claim_are_refused(tmp_path, content, method, complaint):
    with zipfile.ZipFile(tmp_path / "x.npz", "w", method) as archive:
        archive.writestr("a.npy", content)
    with pytest.raises(Malformed, match=complaint):
        read_arrays(tmp_path / "x.npz", ["a"])


def test_large_archives_are_refused_unread(tmp_path):
    with open(tmp_path / "x.npz", "wb") as file:
        file.truncate(reading.MOST_PACKED + 1)
    with pytest.raises(Malformed, match="has more than 8 MiB"):
        read_arrays(tmp_path / "x.npz", ["a"])
