"""Bad files are refused with a sentence, and nothing that goes wrong harms a file."""

import http.server
import pickle
import resource
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pyogrio
import pytest

from polymerge_core.errors import InputError, OutputError
from polymerge_core.io import (
    LayerWarning,
    list_layers,
    read_layers,
    read_table,
    sources,
    stage_layers,
    write_layers,
)
from polymerge_core.outputs import StagedOutputs
from tests.core.layers import EXTENSIONS, LINES, big, digest, layer, only

ROOT = Path(__file__).parents[2]


@pytest.fixture
def gpkg(tmp_path):
    path = tmp_path / "roads.gpkg"
    write_layers(path, {"roads": layer(a=[1, 2])})
    return path


def test_nothing_is_fetched_over_the_network(tmp_path):
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET  # noqa: N815 - the server's name for it

        def log_message(self, *_):
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        for key, kind, address in (("crs", "link", "href"), ("\\u0063rs", "URL", "url")):
            path = tmp_path / "link.geojson"
            path.write_text(
                f'{{"type":"FeatureCollection","{key}":{{"type":"{kind}","properties":{{"{address}":"{url}/crs"}}}},'
                '"features":[{"type":"Feature","properties":{},"geometry":{"type":"LineString",'
                '"coordinates":[[0,0],[1,1]]}}]}'
            )
            with pytest.raises(InputError, match="link to the network"):
                read_layers(path)
        vrt = tmp_path / "v.gpkg"
        vrt.write_text(
            f'<OGRVRTDataSource><OGRVRTLayer name="a"><SrcDataSource>/vsicurl/{url}/a.gpkg</SrcDataSource>'
            "</OGRVRTLayer></OGRVRTDataSource>"
        )
        with pytest.raises(InputError, match="is not a GeoPackage"):
            read_layers(vrt)
        server.shutdown()
    assert asked == []


def damaged(path, damage):
    whole = path.read_bytes()
    path.write_bytes(
        {
            "zero bytes": b"",
            "half": whole[: len(whole) // 2],
            "head": whole[:1000],
            "tail": whole[:-20],
            "garbage": b"garbage " * 100,
            "hole": whole[: len(whole) // 2] + b"\xff" * 400 + whole[len(whole) // 2 + 400 :],
        }[damage]
    )


@pytest.mark.parametrize("damage", ["zero bytes", "half", "head", "tail", "garbage", "hole"])
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_damaged_files_are_refused_by_name(tmp_path, extension, damage):
    path = tmp_path / f"roads.{extension}"
    lines = [f"LINESTRING ({n} 0, {n} 1)" for n in range(200)]
    write_layers(path, {"roads": layer(lines, a=range(200), b=["some text"] * 200)})
    damaged(path, damage)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LayerWarning)
        if (extension, damage) in {("fgb", "hole"), ("shp", "hole"), ("gpkg", "hole")}:
            # Damage in the middle of a coordinate or an index cannot be told from data; it must not crash.
            try:
                read_layers(path)
            except InputError as error:
                assert "roads." in str(error)  # noqa: PT017 - may or may not be raised
        else:
            with pytest.raises(InputError, match=r"roads\."):
                read_layers(path)


@pytest.mark.parametrize("part", [".dbf", ".shx"])
def test_a_shapefile_without_a_part_or_with_a_cut_or_foreign_one_is_refused(tmp_path, part):
    write_layers(tmp_path / "one.shp", {"a": layer(LINES[:1] * 3, a=[1, 2, 3])})
    write_layers(tmp_path / "two.shp", {"a": layer(a=[1, 2])})
    (tmp_path / "one").with_suffix(part).unlink()
    with pytest.raises(InputError, match=rf"one\{part} is missing"):
        read_layers(tmp_path / "one.shp")
    shutil.copy(tmp_path / f"two{part}", tmp_path / f"one{part}")
    with pytest.raises(InputError, match="do not belong together"):
        read_layers(tmp_path / "one.shp")
    cut = (tmp_path / f"two{part}").read_bytes()
    (tmp_path / f"two{part}").write_bytes(cut[:-4])
    with pytest.raises(InputError, match="is cut short"):
        read_layers(tmp_path / "two.shp")


def test_pickles_are_refused_with_a_way_out(tmp_path):
    for name, content in (("a.gpkg", pickle.dumps([1])), ("a.pkl", b"(lp0\n.")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=r"Python pickle.*convert it"):
            read_layers(tmp_path / name)


def test_what_is_not_there_or_not_a_file_or_not_a_map_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_layers(tmp_path / "no.gpkg")
    with pytest.raises(InputError, match="is not a file"):
        read_layers(tmp_path)
    with sqlite3.connect(tmp_path / "a.db") as database:
        database.execute("CREATE TABLE a(b)")
    database.close()
    with pytest.raises(InputError, match="SQLite database, but not a GeoPackage"):
        read_layers(tmp_path / "a.db")
    pq.write_table(pa.table({"a": [1]}), tmp_path / "a.parquet")
    with pytest.raises(InputError, match="Parquet file without geometry"):
        read_layers(tmp_path / "a.parquet")
    (tmp_path / "a.geojson").write_text('{"vectors": []}')
    with pytest.raises(InputError, match=r"a\.geojson"):
        read_layers(tmp_path / "a.geojson")
    write_layers(tmp_path / "a;b.parquet", {"a": layer()})
    with pytest.raises(InputError, match="path with ! or ;"):
        read_layers(tmp_path / "a;b.parquet")
    write_layers(tmp_path / "s.shp", {"a": layer()})
    shutil.copy(tmp_path / "s.shp", tmp_path / "s.dat")
    with pytest.raises(InputError, match="is not called so"):
        read_layers(tmp_path / "s.dat")


def test_an_unknown_layer_is_refused_with_the_known_ones(tmp_path):
    write_layers(tmp_path / "a.gpkg", {"one": layer(), "two": layer(), "table": pd.DataFrame({"x": [1]})})
    with pytest.raises(InputError, match="has no layer three; its layers are one, two, table"):
        read_layers(f"{tmp_path / 'a.gpkg'}|layername=three")
    with pytest.raises(InputError, match="has no layer three; its layers are"):
        read_table(tmp_path / "a.gpkg", "three")
    with pytest.raises(InputError, match="table is a table without geometry"):
        read_layers(tmp_path / "a.gpkg", layer="table")


def test_a_file_of_tables_only_is_refused(tmp_path):
    write_layers(tmp_path / "a.gpkg", {"one": pd.DataFrame({"x": [1]})})
    with pytest.raises(InputError, match=r"no layer of lines or polygons, only tables \(one\)"):
        read_layers(tmp_path / "a.gpkg")


def test_points_are_refused_alone_and_skipped_among_others(tmp_path):
    points = layer(["POINT (0 0)", "POINT (1 1)"])
    write_layers(tmp_path / "p.gpkg", {"trees": points})
    with pytest.raises(InputError, match="layer trees holds points; PolyMerge merges lines and polygons"):
        read_layers(tmp_path / "p.gpkg")
    write_layers(tmp_path / "p.parquet", {"trees": points})
    with pytest.raises(InputError, match="holds points"):
        read_layers(tmp_path / "p.parquet")
    write_layers(tmp_path / "a.gpkg", {"trees": points, "roads": layer()})
    with pytest.raises(InputError, match="layer trees holds points"):
        read_layers(tmp_path / "a.gpkg", layer="trees")
    with pytest.warns(LayerWarning, match="layer trees holds points.*is skipped"):
        assert list(read_layers(tmp_path / "a.gpkg")) == ["roads"]


def test_points_in_a_layer_of_any_geometry_are_found_by_looking(tmp_path):
    write_layers(tmp_path / "a.gpkg", {"roads": layer()})
    pyogrio.write_dataframe(layer(["POINT (0 0)"]), tmp_path / "a.gpkg", layer="trees", geometry_type="Unknown")
    with pytest.warns(LayerWarning, match="trees holds points.*is skipped"):
        assert list(read_layers(tmp_path / "a.gpkg")) == ["roads"]


# -- locks, journals and logs of other programs


def child(code, *arguments):
    return subprocess.run([sys.executable, "-c", code, *map(str, arguments)], check=False, timeout=60)


def test_reading_changes_nothing(gpkg):
    before = digest(gpkg)
    names = sorted(path.name for path in gpkg.parent.iterdir())
    read_layers(gpkg)
    list_layers(gpkg)
    assert digest(gpkg) == before
    assert sorted(path.name for path in gpkg.parent.iterdir()) == names


def test_a_locked_geopackage_is_said_to_be_locked_soon(gpkg, monkeypatch):
    monkeypatch.setattr(sources, "_LOCK_SECONDS", 0.3)
    code = (
        "import sqlite3, sys\ndatabase = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
        "database.execute('BEGIN EXCLUSIVE')\nprint('locked', flush=True)\nsys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(gpkg)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"locked\n"
        started = time.monotonic()
        with pytest.raises(InputError, match=r"roads\.gpkg is locked: another program"):
            read_layers(gpkg)
        assert time.monotonic() - started < 3
        process.stdin.close()
    assert len(only(gpkg)) == 2


CRASH = """
import os, sqlite3, sys
database = sqlite3.connect(sys.argv[1], isolation_level=None)
database.execute(f"PRAGMA journal_mode = {sys.argv[2]}")
database.execute("PRAGMA cache_size = 1")
for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
    database.execute(f'DROP TRIGGER "{name}"')
database.execute("BEGIN")
database.execute("CREATE TABLE zz(a TEXT)")
database.executemany("INSERT INTO zz VALUES (?)", [("x" * 1000,)] * 1000)
database.execute("UPDATE roads SET a = 7 WHERE fid = 1")
if sys.argv[2] == "wal":
    database.execute("COMMIT")
os._exit(0)
"""


def test_a_hot_journal_is_told_and_kept(gpkg):
    child(CRASH, gpkg, "delete")
    before = digest(gpkg)
    journal = gpkg.with_name("roads.gpkg-journal")
    assert journal.stat().st_size > 0
    with pytest.raises(InputError, match="a program crashed while writing to it"):
        read_layers(gpkg)
    assert journal.exists()
    assert digest(gpkg) == before


def test_a_write_ahead_log_is_read_but_not_merged_into_the_file(gpkg):
    child(CRASH, gpkg, "wal")
    before = digest(gpkg)
    log = gpkg.with_name("roads.gpkg-wal")
    assert log.stat().st_size > 0
    with pytest.warns(LayerWarning, match="open in another program, or a program crashed"):
        assert only(gpkg).a.tolist() == [7, 2]
    assert log.stat().st_size > 0
    assert digest(gpkg) == before


def test_a_geopackage_in_write_ahead_mode_is_read_without_a_trace(gpkg):
    with sqlite3.connect(gpkg) as database:
        database.execute("PRAGMA journal_mode = wal")
    database.close()
    before = digest(gpkg)
    assert len(only(gpkg)) == 2
    assert digest(gpkg) == before
    assert sorted(path.name for path in gpkg.parent.iterdir()) == ["roads.gpkg"]


# -- safe writes


def test_an_output_cannot_be_an_input(gpkg):
    before = digest(gpkg)
    with pytest.raises(OutputError, match="is an input of this run"):
        write_layers(gpkg, {"a": layer()}, overwrite=True, inputs=[f"{gpkg}|layername=roads"])
    assert digest(gpkg) == before


def test_layers_and_a_report_appear_together(tmp_path):
    with pytest.raises(ZeroDivisionError), StagedOutputs() as outputs:  # noqa: PT012
        stage_layers(outputs, tmp_path / "a.gpkg", {"a": layer()})
        outputs.stage(tmp_path / "report.json").write_text("{}")
        1 / 0  # noqa: B018 - anything that fails late
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("share", [0.02, 0.5, 0.95])
def test_a_file_size_limit_leaves_the_old_file(tmp_path, extension, share):
    target = tmp_path / f"a.{extension}"
    write_layers(target, {"a": big()})
    size = target.stat().st_size
    write_layers(target, {"a": layer()}, overwrite=True)
    before = {path.name: digest(path) for path in tmp_path.iterdir()}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(size * share), limits[1]))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LayerWarning)
            with pytest.raises(OutputError, match=r"a\.\w+ cannot be written.*disk"):
                write_layers(target, {"a": big()}, overwrite=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert {path.name: digest(path) for path in tmp_path.iterdir()} == before


FULL = """
import sys, warnings
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from polymerge_core.errors import OutputError
from polymerge_core.io import write_layers
from tests.core.layers import EXTENSIONS, big, digest, layer
warnings.simplefilter("ignore")
for extension in EXTENSIONS:
    target = Path(sys.argv[2], "a." + extension)
    write_layers(target, {"a": layer()})
    before = {path.name: digest(path) for path in target.parent.iterdir()}
    try:
        write_layers(target, {"a": big(20000)}, overwrite=True)
    except OutputError as error:
        assert "disk" in str(error), error
    else:
        raise SystemExit(extension + " was written to a full disk")
    assert {path.name: digest(path) for path in target.parent.iterdir()} == before
print("all refused")
"""


def test_a_full_disk_leaves_the_old_file(tmp_path):
    mount = 'mount -t tmpfs -o size=800k tmpfs "$0" && exec "$@"'
    probe = ["unshare", "-m", "sh", "-c", mount, str(tmp_path)]
    try:
        subprocess.run([*probe, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("a small file system can be mounted by root on Linux only")
    command = [*probe, sys.executable, "-c", FULL, str(ROOT), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=100)
    assert done.stdout == "all refused\n", done.stderr


WRITER = """
import os, random, signal, sqlite3, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from polymerge_core.io import write_layers
from tests.core.layers import big, temporaries
target, frame, moment = Path(sys.argv[2]), big(), random.Random(0)
left = 0
for _ in range(8):
    pid = os.fork()
    if pid == 0:
        while True:
            write_layers(target, {"a": frame, "b": frame}, overwrite=True)
    time.sleep(moment.uniform(0.05, 0.3))
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    left += len(temporaries(target.parent))
    database = sqlite3.connect(target)
    print(*(database.execute(f"SELECT count(*) FROM {name}").fetchone()[0] for name in "ab"))
    print(database.execute("PRAGMA integrity_check").fetchone()[0])
    database.close()
print(left > 0)
"""


def test_a_run_killed_at_any_moment_leaves_the_old_or_the_new_file(tmp_path):
    target = tmp_path / "a.gpkg"
    write_layers(target, {"a": layer(), "b": layer()})
    command = [sys.executable, "-W", "ignore", "-c", WRITER, str(ROOT), str(target)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100)
    *counts, killed_while_writing = done.stdout.splitlines()
    assert set(counts) <= {"2 2", "3000 3000", "ok"}
    assert killed_while_writing == "True"
    write_layers(target, {"a": layer()}, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["a.gpkg"]
