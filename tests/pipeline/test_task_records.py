"""Records of finished tasks: looking them up, digests of what they were made from."""

from ltsh_addon.pipeline import PictureOptions, tasks


def test_records_of_some_names_are_looked_up_without_reading_the_others(tmp_path, monkeypatch):
    records = tasks.Records(tmp_path, "tiles")
    names = ["Floor.1001", "Floor.1002", "Floor 2.1001", "a[b].1001", "x/Floor.1001", "ab.1001"]
    for name in names:
        records.write(name, "key", {"name": name}, ())
    read = []
    read_one = tasks._read
    monkeypatch.setattr(tasks, "_read", lambda path: read.append(path) or read_one(path))

    def found(*stems):
        return {record["task"]["name"] for record in records.all_whole("key", stems or None)}

    assert found() == set(names) and found("Floor") == {"Floor.1001", "Floor.1002"} and len(read) == len(names) + 2
    assert found("a[b]") == {"a[b].1001"} and found("y") == set()
    assert found("x/Floor", "ab") == {"x/Floor.1001", "ab.1001"}


def test_a_changed_file_has_another_digest(tmp_path):
    room = tmp_path / "room.blend"
    room.write_bytes(b"BLENDER")
    options = PictureOptions(room, tmp_path, techniques=("ltc",))
    first = tasks.contents_digest(options)
    assert tasks.contents_digest(options) == first
    room.write_bytes(b"BLENDER, other")
    assert tasks.contents_digest(options) != first
