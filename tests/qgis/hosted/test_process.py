"""Running a program: its lines, its end, its environment, and a cancel that does not wait."""

from __future__ import annotations

import json
import os
import sys
import threading
import time

import pytest
from qgis.core import QgsFeedback

from qgis_plugin.process import clean_environment, run_program

#: What a cancel may take: a second as it is promised, and what a busy machine adds.
PROMPT_S = 1.5


def run(code, *, feedback=None, on_line=None, environment=None):
    """Run lines of Python in a program of their own; return how it ended and its lines."""
    lines = []
    ended = run_program(
        sys.executable,
        ["-c", code],
        environment=environment or clean_environment(),
        feedback=feedback or QgsFeedback(),
        on_line=on_line or lines.append,
    )
    return ended, lines


class TestLines:
    def test_come_from_both_outputs(self):
        ended, lines = run("import sys; print('out', flush=True); print('err', file=sys.stderr)")
        assert ended.well
        assert lines == ["out", "err"]

    def test_the_last_one_needs_no_newline(self):
        assert run("import sys; sys.stdout.write('one\\ntwo')")[1] == ["one", "two"]

    def test_come_one_by_one_while_the_program_still_runs(self):
        times = []
        run("import time; print(1, flush=True); time.sleep(0.5); print(2)", on_line=lambda _: times.append(time.time()))
        assert times[1] - times[0] > 0.3

    def test_one_that_comes_in_pieces_is_one(self):
        code = (
            "import sys, time\nfor part in ('on', 'e li', 'ne\\n'):\n"
            " sys.stdout.write(part); sys.stdout.flush(); time.sleep(.1)"
        )
        assert run(code)[1] == ["one line"]

    def test_empty_ones_and_carriage_returns_are_left_out(self):
        assert run("import sys; sys.stdout.buffer.write(b'a\\r\\n\\r\\n  \\nb\\n')")[1] == ["a", "b"]

    def test_letters_are_read_as_utf_8_whatever_the_locale(self):
        environment = clean_environment(LC_ALL="C")
        assert run("print('Straße 線 \\N{GRINNING FACE}')", environment=environment)[1] == [
            "Straße 線 \N{GRINNING FACE}"
        ]

    def test_a_letter_that_comes_in_two_pieces_is_one(self):
        code = (
            "import sys, time\nfor part in (b'\\xc3', b'\\xa4\\n'):\n"
            " sys.stdout.buffer.write(part); sys.stdout.flush(); time.sleep(.1)"
        )
        assert run(code)[1] == ["ä"]

    def test_bytes_that_are_no_text_do_not_stop_the_run(self):
        ended, lines = run("import sys; sys.stdout.buffer.write(b'a\\xff\\xfe\\nb\\n')")
        assert ended.well
        assert lines == ["a\N{REPLACEMENT CHARACTER}\N{REPLACEMENT CHARACTER}", "b"]

    def test_of_a_great_output_none_is_lost(self):
        ended, lines = run("for n in range(100_000): print(n, 'x' * 50)")
        assert ended.well
        assert [line.split()[0] for line in lines] == [str(n) for n in range(100_000)]

    def test_a_line_of_megabytes_comes_whole(self):
        assert [len(line) for line in run("print('x' * 3_000_000)")[1]] == [3_000_000]

    def test_what_the_listener_raises_reaches_the_caller_and_ends_the_program(self, tmp_path):
        late = str(tmp_path / "late")
        code = f"import time, pathlib; print(1, flush=True); time.sleep(0.6); pathlib.Path({late!r}).touch()"

        def refuse(line):
            raise KeyError(line)

        with pytest.raises(KeyError):
            run(code, on_line=refuse)
        time.sleep(0.8)
        assert not (tmp_path / "late").exists()


class TestEnd:
    @pytest.mark.parametrize("code", [0, 1, 2, 130])
    def test_tells_the_exit_code(self, code):
        ended, _ = run(f"raise SystemExit({code})")
        assert (ended.code, ended.cancelled, ended.not_started) == (code, False, "")
        assert ended.well == (code == 0)

    def test_a_crash_has_no_exit_code(self):
        ended, lines = run("import os, signal; print('so far', flush=True); os.kill(os.getpid(), signal.SIGKILL)")
        assert (ended.code, ended.cancelled, ended.not_started) == (None, False, "")
        assert not ended.well
        assert lines == ["so far"]

    @pytest.mark.parametrize("mode", [None, 0o644, 0o755], ids=["not there", "no program", "no format"])
    def test_what_cannot_be_started_says_why(self, tmp_path, mode):
        file = tmp_path / "program"
        if mode is not None:
            file.write_bytes(b"\x00\x01 this is no program")
            file.chmod(mode)
        ended = run_program(
            str(file), [], environment=clean_environment(), feedback=QgsFeedback(), on_line=lambda _line: None
        )
        assert ended.code is None
        assert ended.not_started
        assert not ended.well

    def test_arguments_come_as_they_are(self):
        lines = []
        odd = ["", "a b", "--x=", '"quoted"', "$HOME;`ls`", "*", "ü線", "back\\slash", "new\nline"]
        code = "import sys, json; print(json.dumps(sys.argv[1:]))"
        run_program(
            sys.executable,
            ["-c", code, *odd],
            environment=clean_environment(),
            feedback=QgsFeedback(),
            on_line=lines.append,
        )
        assert json.loads(lines[0]) == odd


class TestCancel:
    def cancelled(self, code, after=0.5):
        feedback = QgsFeedback()
        moment = []

        def cancel():
            moment.append(time.monotonic())
            feedback.cancel()

        timer = threading.Timer(after, cancel)
        timer.start()
        ended, lines = run(code, feedback=feedback)
        timer.join()
        return ended, lines, time.monotonic() - moment[0]

    def test_a_program_that_watches_its_input_ends_by_itself(self):
        code = "import sys; sys.stdin.read(); print('tidied'); raise SystemExit(130)"
        ended, lines, took = self.cancelled(code)
        assert (ended.code, ended.cancelled, ended.well) == (130, True, False)
        assert lines == ["tidied"]
        assert took < PROMPT_S

    def test_one_that_does_not_listen_is_killed(self):
        code = "import signal, time\nfor n in (2, 15): signal.signal(n, signal.SIG_IGN)\nprint('up')\ntime.sleep(60)"
        ended, _, took = self.cancelled(code)
        assert (ended.code, ended.cancelled) == (None, True)
        assert took < PROMPT_S

    def test_one_that_talks_without_end_is_killed(self):
        ended, lines, took = self.cancelled("while True: print('x' * 1000)")
        assert ended.cancelled
        assert took < PROMPT_S
        assert lines

    def test_before_the_start_ends_it_at_once(self):
        feedback = QgsFeedback()
        feedback.cancel()
        start = time.monotonic()
        ended, _ = run("import time; time.sleep(60)", feedback=feedback)
        assert ended.cancelled
        assert time.monotonic() - start < PROMPT_S

    def test_a_program_that_ends_well_just_then_still_counts_as_cancelled(self):
        feedback = QgsFeedback()

        def cancel(_line):
            feedback.cancel()

        ended, _ = run("print(1, flush=True); import sys; sys.stdin.read()", feedback=feedback, on_line=cancel)
        assert (ended.code, ended.cancelled, ended.well) == (0, True, False)

    def test_standard_input_stays_open_until_then(self):
        code = (
            "import select, sys\nended = select.select([sys.stdin], [], [], 1)[0]\nprint('closed' if ended else 'open')"
        )
        assert run(code)[1] == ["open"]


class TestCleanEnvironment:
    @pytest.mark.parametrize(
        "name",
        [
            "PYTHONPATH",
            "PYTHONHOME",
            "PYTHONSTARTUP",
            "PYENV_VERSION",
            "VIRTUAL_ENV",
            "CONDA_PREFIX",
            "PROJ_LIB",
            "PROJ_DATA",
            "GDAL_DATA",
            "GDAL_DRIVER_PATH",
            "OGR_SQLITE_PRAGMA",
            "GEOS_X",
            "CPL_DEBUG",
            "LD_LIBRARY_PATH",
            "LD_PRELOAD",
            "DYLD_LIBRARY_PATH",
            "QT_PLUGIN_PATH",
            "QT_QPA_PLATFORM",
            "QML2_IMPORT_PATH",
            "O4W_QT_PREFIX",
            "PIP_USER",
            "PIP_TARGET",
            "PIP_PREFIX",
            "PythonPath",
            "gdal_data",
        ],
    )
    def test_drops_what_is_meant_for_qgis(self, monkeypatch, name):
        monkeypatch.setenv(name, "/nowhere")
        assert not clean_environment().contains(name)

    @pytest.mark.parametrize(
        "name",
        [
            "PATH",
            "HOME",
            "LANG",
            "TMPDIR",
            "HTTPS_PROXY",
            "SSL_CERT_FILE",
            "PIP_INDEX_URL",
            "PIP_CERT",
            "SYSTEMROOT",
            "MY_GDAL_X",
        ],
    )
    def test_keeps_what_any_program_needs(self, monkeypatch, name):
        monkeypatch.setenv(name, "/kept")
        assert clean_environment().value(name) == "/kept"

    def test_sets_what_it_is_told_after_dropping(self, monkeypatch):
        monkeypatch.setenv("PYTHONPATH", "/foreign")
        assert clean_environment(PYTHONPATH="/own").value("PYTHONPATH") == "/own"

    def test_has_python_write_utf_8(self):
        assert clean_environment().value("PYTHONUTF8") == "1"

    def test_has_python_import_nothing_from_the_folder_it_is_started_in(self, monkeypatch, tmp_path):
        (tmp_path / "colorsys.py").write_text("raise SystemExit('a foreign module')")
        monkeypatch.chdir(tmp_path)
        ended, lines = run("import colorsys; print('fine')")
        assert (ended.code, lines) == (0, ["fine"])

    def test_is_the_whole_environment_of_the_program(self, monkeypatch):
        monkeypatch.setenv("PROJ_LIB", "/nowhere")
        code = "import os; print(os.environ.get('PROJ_LIB'), os.environ['X'])"
        assert run(code, environment=clean_environment(X="1"))[1] == ["None 1"]

    def test_leaves_the_environment_of_qgis_alone(self, monkeypatch):
        monkeypatch.setenv("PROJ_LIB", "/kept")
        clean_environment()
        assert os.environ["PROJ_LIB"] == "/kept"
