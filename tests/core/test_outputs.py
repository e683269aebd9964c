"""Outputs appear whole and together, or not at all."""

import errno
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from polymerge_core import outputs as module
from polymerge_core.errors import OutputError
from polymerge_core.outputs import StagedOutputs


def temporaries(folder):
    return [entry.name for entry in Path(folder).iterdir() if entry.name.startswith(".polymerge-")]


def write(target, text="new", **options):
    with StagedOutputs(**options) as outputs:
        outputs.stage(target).write_text(text)


@pytest.fixture
def old(tmp_path):
    target = tmp_path / "map.gpkg"
    target.write_text("old")
    return target


def test_an_output_is_not_there_before_the_end_and_is_there_after_it(tmp_path):
    target = tmp_path / "map.gpkg"
    with StagedOutputs() as outputs:
        staged = outputs.stage(target)
        staged.write_text("new")
        assert staged.name == target.name
        assert staged.parent.parent == tmp_path
        assert not target.exists()
    assert target.read_text() == "new"
    assert temporaries(tmp_path) == []


def test_an_existing_output_needs_overwrite(old):
    with pytest.raises(OutputError, match=r"map\.gpkg exists: overwrite it"):
        write(old)
    assert old.read_text() == "old"
    write(old, overwrite=True)
    assert old.read_text() == "new"


@pytest.mark.parametrize("error", [RuntimeError("x"), KeyboardInterrupt(), SystemExit(3)], ids=repr)
def test_nothing_changes_when_the_run_ends_early(tmp_path, old, error):
    other = tmp_path / "report.json"
    with pytest.raises(type(error)), StagedOutputs(overwrite=True) as outputs:  # noqa: PT012
        outputs.stage(old).write_text("new")
        outputs.stage(other).write_text("{}")
        raise error
    assert old.read_text() == "old"
    assert not other.exists()
    assert temporaries(tmp_path) == []


@pytest.mark.parametrize("failing", [1, 2, 3])
def test_a_move_that_fails_brings_all_earlier_ones_back(tmp_path, monkeypatch, failing):
    targets = [tmp_path / name for name in ("a.gpkg", "b.json", "c.fgb")]
    targets[0].write_text("old a")
    targets[2].write_text("old c")
    replace, calls = Path.replace, []

    def replace_once_less(self, target):
        calls.append(target)
        if len(calls) == failing:
            raise OSError(errno.EIO, "Input/output error")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", replace_once_less)
    with pytest.raises(OutputError, match="Input/output error"), StagedOutputs(overwrite=True) as outputs:  # noqa: PT012
        for target in targets:
            outputs.stage(target).write_text("new")
    assert [target.read_text() if target.exists() else None for target in targets] == ["old a", None, "old c"]
    assert temporaries(tmp_path) == []


def test_without_hard_links_the_old_files_still_come_back(tmp_path, old, monkeypatch):
    def no_link(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    def no_sync(_):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "link", no_link)
    synced = module._sync
    monkeypatch.setattr(module, "_sync", lambda path: no_sync(path) if path.is_dir() else synced(path))
    with pytest.raises(OutputError):
        write(old, overwrite=True)
    assert old.read_text() == "old"


@pytest.mark.parametrize("interrupted_move", [1, 2])
def test_an_interrupt_while_files_are_moved_changes_nothing(tmp_path, monkeypatch, interrupted_move):
    targets = [tmp_path / "a.gpkg", tmp_path / "b.json"]
    move, calls = module._move, []

    def interrupted(source, target):
        move(source, target)
        calls.append(target)
        if len(calls) == interrupted_move:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(module, "_move", interrupted)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), StagedOutputs() as outputs:  # noqa: PT012
        for target in targets:
            outputs.stage(target).write_text("new")
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_while_temporaries_are_removed_is_raised_afterwards(tmp_path, monkeypatch):
    remove = module.shutil.rmtree

    def interrupted(*arguments, **options):
        signal.raise_signal(signal.SIGINT)
        remove(*arguments, **options)

    monkeypatch.setattr(module.shutil, "rmtree", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "a.json")
    assert temporaries(tmp_path) == []


def test_an_output_that_nobody_wrote_is_an_error(tmp_path):
    with pytest.raises(OutputError, match="was not written"), StagedOutputs() as outputs:
        outputs.stage(tmp_path / "a.json")


def test_all_parts_of_a_shapefile_are_moved_and_old_ones_removed(tmp_path):
    for suffix in (".shp", ".shx", ".dbf", ".prj", ".qix", ".qml"):
        (tmp_path / f"roads{suffix}").write_text("old")
    with StagedOutputs(overwrite=True) as outputs:
        staged = outputs.stage(tmp_path / "roads.shp")
        for suffix in (".shp", ".shx", ".dbf", ".cpg"):
            staged.with_suffix(suffix).write_text("new")
    found = {path.suffix: path.read_text() for path in tmp_path.iterdir()}
    assert found == {".shp": "new", ".shx": "new", ".dbf": "new", ".cpg": "new", ".qml": "old"}


def test_a_part_of_a_shapefile_counts_as_an_existing_output(tmp_path):
    (tmp_path / "roads.dbf").write_text("a table of its own")
    with pytest.raises(OutputError, match=r"roads\.dbf exists"):
        write(tmp_path / "roads.shp")


def refuse(message, targets, **options):
    with pytest.raises(OutputError, match=message):
        StagedOutputs(**options).check(targets)


def test_an_input_is_never_replaced(tmp_path, old):
    refuse("is an input of this run", [old], overwrite=True, inputs=[old])
    link = tmp_path / "link.gpkg"
    link.symlink_to(old)
    refuse("is an input of this run", [link], overwrite=True, inputs=[old])
    refuse("is an input of this run", [old], overwrite=True, inputs=[link])
    (tmp_path / "folder").symlink_to(tmp_path)
    refuse("is an input of this run", [tmp_path / "folder" / old.name], overwrite=True, inputs=[old])
    hard = tmp_path / "hard.gpkg"
    os.link(old, hard)
    refuse("is an input of this run", [hard], overwrite=True, inputs=[old])


def test_a_part_of_an_input_shapefile_is_never_replaced(tmp_path):
    for suffix in (".shp", ".shx", ".dbf"):
        (tmp_path / f"roads{suffix}").write_text("old")
    (tmp_path / "other.dbf").symlink_to(tmp_path / "roads.dbf")
    refuse("is an input", [tmp_path / "other.shp"], overwrite=True, inputs=[tmp_path / "roads.shp"])


def test_an_input_named_relatively_is_known(tmp_path, old, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refuse("is an input", [Path("map.gpkg")], overwrite=True, inputs=[old])
    refuse("is an input", [old], overwrite=True, inputs=["./map.gpkg"])


def test_two_outputs_cannot_be_one_file(tmp_path):
    refuse("two outputs", [tmp_path / "a.json", tmp_path / "." / "a.json"])
    with pytest.raises(OutputError, match="two outputs"), StagedOutputs() as outputs:  # noqa: PT012
        outputs.stage(tmp_path / "a.json").write_text("x")
        outputs.stage(tmp_path / "a.json")
    assert list(tmp_path.iterdir()) == []


def test_bad_places_are_refused_before_any_work(tmp_path, old):
    refuse("does not exist; create it first", [tmp_path / "no" / "a.gpkg"])
    refuse("is a file, not a folder", [old / "a.gpkg"])
    refuse("is a folder: name a file in it", [tmp_path])
    refuse("is a device or a pipe", [Path("/dev/null")], overwrite=True)
    refuse("not a path", ["a\0b.gpkg"])
    refuse("cannot be written", [tmp_path / ("x" * 300 + ".gpkg")])
    assert temporaries(tmp_path) == []


def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path, monkeypatch):
    def denied(**_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(module.tempfile, "mkdtemp", denied)
    refuse("cannot be written to: Permission denied", [tmp_path / "a.gpkg"])


def test_a_read_only_output_is_refused(old, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    refuse("is read-only", [old], overwrite=True)


@pytest.mark.parametrize("suffix", ["-wal", "-journal"])
@pytest.mark.parametrize("exists", [True, False], ids=["target", "no target"])
def test_a_geopackage_in_use_is_refused_and_its_log_kept(old, suffix, exists):
    log = old.with_name(old.name + suffix)
    log.write_text("log")
    if not exists:
        old.unlink()
    refuse("open in another program, or a program crashed", [old], overwrite=True)
    assert log.read_text() == "log"


def test_an_empty_rollback_journal_is_no_obstacle(old):
    old.with_name(old.name + "-journal").touch()
    StagedOutputs(overwrite=True).check([old])


def test_a_check_can_be_followed_by_the_run(tmp_path):
    outputs = StagedOutputs()
    outputs.check([tmp_path / "a.json"])
    with outputs:
        outputs.stage(tmp_path / "a.json").write_text("x")
    assert (tmp_path / "a.json").read_text() == "x"


def test_a_symbolic_link_is_written_through(tmp_path, old):
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "elsewhere" / "link.gpkg"
    link.symlink_to(old)
    write(link, overwrite=True)
    assert link.is_symlink()
    assert old.read_text() == "new"


def test_an_overwritten_file_keeps_its_permissions(old):
    old.chmod(0o640)
    write(old, overwrite=True)
    assert old.stat().st_mode & 0o777 == 0o640


def test_a_full_disk_is_said_so(tmp_path, old):
    with pytest.raises(OutputError, match="disk full"), StagedOutputs(overwrite=True) as outputs:  # noqa: PT012
        outputs.stage(old)
        raise OSError(errno.ENOSPC, "No space left on device")
    assert old.read_text() == "old"
    assert temporaries(tmp_path) == []


def test_a_file_size_limit_is_an_error_and_not_the_end_of_the_process(tmp_path, old):
    def deadly(*_):
        raise SystemExit(99)

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    previous = signal.signal(signal.SIGXFSZ, deadly)
    try:
        with pytest.raises(OutputError, match="disk full"), StagedOutputs(overwrite=True) as outputs:  # noqa: PT012
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
            outputs.stage(old).write_bytes(b"x" * 5000)
        assert signal.getsignal(signal.SIGXFSZ) is deadly
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, previous)
    assert old.read_text() == "old"
    assert temporaries(tmp_path) == []


KILLED = """
import sys, time
from polymerge_core.outputs import StagedOutputs
with StagedOutputs(overwrite=True) as outputs:
    staged = outputs.stage(sys.argv[1])
    staged.write_bytes(b"half")
    print("writing", flush=True)
    time.sleep(60)
"""


def test_what_a_killed_run_left_is_removed_by_the_next_one_only_when_it_is_dead(tmp_path, old):
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(old)], stdout=subprocess.PIPE)
    try:
        assert process.stdout.readline() == b"writing\n"
        write(tmp_path / "first.json")
        assert len(temporaries(tmp_path)) == 1, "a run that lives keeps its files"
    finally:
        process.kill()
        process.communicate()
    assert old.read_text() == "old"
    assert len(temporaries(tmp_path)) == 1
    write(tmp_path / "second.json")
    assert temporaries(tmp_path) == []


def test_leftovers_of_other_computers_and_strange_names_are_kept_for_a_week(tmp_path):
    foreign = tmp_path / ".polymerge-00000000-1-abc"
    ancient = tmp_path / ".polymerge-00000000-2-abc"
    strange = tmp_path / ".polymerge-mine"
    for folder in (foreign, ancient, strange):
        folder.mkdir()
    os.utime(ancient, (time.time() - 8 * 24 * 3600,) * 2)
    write(tmp_path / "a.json")
    assert sorted(temporaries(tmp_path)) == [foreign.name, strange.name]
