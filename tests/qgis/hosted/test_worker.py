"""The worker as a process: what it says reaches the user, how it ends becomes a sentence; stand-ins in shell here."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from qgis.core import QgsProcessingException, QgsProcessingUtils

from qgis_plugin import environment
from qgis_plugin.layout import ROOT
from qgis_plugin.progress import Part
from qgis_plugin.worker import run_worker, workspace

pytestmark = pytest.mark.usefixtures("provider")


@pytest.fixture
def work(script, feedback):
    """Return a function that runs a worker whose Python is lines of shell."""

    def go(shell, *arguments, part=None, shown_as=None):
        environment.use_interpreter(script(shell))
        run_worker("merge", arguments, part or Part(feedback), shown_as=shown_as or {})

    return go


def fault(work, shell, **options):
    with pytest.raises(QgsProcessingException) as told:
        work(shell, **options)
    return str(told.value)


class TestMessages:
    def test_of_progress_move_the_bar_within_the_part_and_are_shown_once(self, work, feedback):
        lines = [(0.0, "reading"), (0.5, "merging"), (0.75, "merging"), (1.0, "done")]
        shell = "\n".join(f"""echo '{{"fraction": {fraction}, "message": "{text}"}}' >&2""" for fraction, text in lines)
        work(shell, part=Part(feedback, 0.1, 0.9))
        assert feedback.progresses == pytest.approx([10, 50, 70, 90])
        assert feedback.texts == ["reading", "merging", "done"]

    def test_of_warning_are_warnings_and_the_rest_is_for_information(self, work, feedback):
        work("echo 'warning: layer a: is empty' >&2; echo '3 observations became 1 element'")
        assert feedback.warnings == ["layer a: is empty"]
        assert feedback.infos == ["3 observations became 1 element"]
        assert feedback.errors == []

    @pytest.mark.parametrize("kind", ["warning: ", "error: ", ""])
    def test_name_layers_and_not_their_temporary_files(self, work, feedback, kind):
        shell = f"echo '{kind}/gone/x y/a.gpkg, feature 3: bad' >&2; exit {1 if kind == 'error: ' else 0}"
        shown_as = {"/gone/x y/a.gpkg": "“tracks”"}
        if kind == "error: ":
            assert fault(work, shell, shown_as=shown_as) == "“tracks”, feature 3: bad"
        else:
            work(shell, shown_as=shown_as)
        assert not any("/gone/x" in each for each in feedback.everything)
        if kind != "error: ":
            assert "“tracks”, feature 3: bad" in feedback.everything

    def test_of_error_become_the_error_of_the_algorithm(self, work, feedback):
        assert fault(work, "echo 'error: there is no column x: the columns are a, b' >&2; exit 1") == (
            "there is no column x: the columns are a, b"
        )
        assert feedback.errors == []

    def test_of_error_do_not_spoil_a_run_that_ends_well(self, work):
        work("echo 'error: not so bad' >&2")

    def test_a_line_of_progress_that_a_crash_cut_off_does_not_hide_the_crash(self, work):
        message = fault(work, """printf '{"fraction": 0.' >&2; kill -9 $$""")
        assert message.startswith("The worker was killed or crashed")

    def test_a_line_that_only_looks_like_progress_does_not_end_the_run(self, work):
        work("""echo '{"fraction" of the lines}' >&2""")


class TestCommand:
    def test_is_the_command_line_with_progress_and_an_eye_on_its_input(self, work, feedback):
        work('echo "$@"', "--strict", "--", "a b")
        assert feedback.infos == ["-m polymerge_core merge --progress=json --watch-stdin --strict -- a b"]

    def test_finds_the_core_of_the_plugin_and_nothing_of_the_host(self, work, feedback, monkeypatch):
        for name in ("PYTHONPATH", "PROJ_LIB", "GDAL_DATA", "PYTHONHOME"):
            monkeypatch.setenv(name, "/nonsense")
        work('echo "$PYTHONPATH|$PROJ_LIB|$GDAL_DATA|$PYTHONHOME"')
        assert feedback.infos == [f"{ROOT}|||"]


class TestEnd:
    def test_without_an_environment_says_what_to_do(self, feedback):
        with pytest.raises(QgsProcessingException, match="run “Set up PolyMerge”"):
            run_worker("merge", [], Part(feedback), shown_as={})

    def test_for_a_missing_library_says_what_to_do(self, work):
        shell = (
            "echo 'Traceback (most recent call last):'; echo \"ModuleNotFoundError: No module named 'shapely'\"; exit 1"
        )
        assert fault(work, shell) == (
            "The Python environment of PolyMerge is not complete (ModuleNotFoundError: No module named 'shapely'): "
            "run “Set up PolyMerge”."
        )

    def test_for_a_library_that_does_not_load_says_what_to_do(self, work):
        assert "is not complete (ImportError: libGL" in fault(
            work, "echo 'ImportError: libGL.so.1: no such file'; exit 1"
        )

    def test_by_a_crash_says_so(self, work):
        assert fault(work, "echo going; kill -SEGV $$") == (
            "The worker was killed or crashed, perhaps for want of memory: merge the data in parts."
        )

    def test_by_a_kill_from_outside_says_so(self, work, tmp_path):
        def kill():
            while not (file := tmp_path / "pid").exists() or not file.read_text().strip():
                time.sleep(0.02)
            os.kill(int(file.read_text()), signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        start = time.monotonic()
        message = fault(work, f"echo $$ > '{tmp_path}/pid'; exec sleep 30")
        killer.join()
        assert message.startswith("The worker was killed or crashed")
        assert time.monotonic() - start < 5

    def test_with_an_error_said_before_a_crash_tells_the_error(self, work):
        assert fault(work, "echo 'error: not enough memory' >&2; kill -9 $$") == "not enough memory"

    def test_of_another_kind_tells_the_exit_code_and_the_last_words(self, work):
        shell = "for n in 1 2 3 4; do echo word $n; done; exit 7"
        assert fault(work, shell) == "The worker ended with exit code 7: word 2 | word 3 | word 4"

    def test_without_a_word_tells_the_exit_code(self, work):
        assert fault(work, "exit 7") == "The worker ended with exit code 7: "

    def test_of_what_cannot_be_started_says_what_to_do(self, feedback, tmp_path):
        file = tmp_path / "python"
        file.write_bytes(b"\x00\x01")
        file.chmod(0o755)
        environment.use_interpreter(str(file))
        with pytest.raises(QgsProcessingException) as told:
            run_worker("merge", [], Part(feedback), shown_as={})
        assert str(told.value).startswith(f"{file} cannot be started (")
        assert str(told.value).endswith("run “Set up PolyMerge”.")

    def test_by_a_cancel_says_so_within_a_second(self, work, feedback):
        timer = threading.Timer(0.4, feedback.cancel)
        timer.start()
        start = time.monotonic()
        assert fault(work, "exec sleep 30") == "Cancelled; nothing was written."
        assert time.monotonic() - start < 0.4 + 1.5

    def test_by_a_cancel_does_not_show_what_the_worker_says_of_it(self, work, feedback):
        timer = threading.Timer(0.4, feedback.cancel)
        timer.start()
        fault(work, "echo going; cat > /dev/null; echo 'interrupted; nothing was left behind' >&2; exit 130")
        assert feedback.everything == ["going"]


class TestWorkspace:
    def test_lies_in_the_temporary_folder_of_processing_and_is_gone_afterwards(self):
        with workspace() as folder:
            assert folder.parent == Path(QgsProcessingUtils.tempFolder())
            (folder / "deep" / "er").mkdir(parents=True)
            (folder / "deep" / "er" / "file").touch()
        assert not folder.exists()

    def test_is_gone_after_an_error_too(self):
        with pytest.raises(KeyError), workspace() as folder:
            raise KeyError
        assert not folder.exists()

    def test_is_another_for_each_run(self):
        with workspace() as one, workspace() as other:
            assert one != other
