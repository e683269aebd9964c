"""`polymerge:setup` with programs that stand for a Python: what it runs, what it says, what it leaves behind."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

import pytest
from processing.core.ProcessingConfig import ProcessingConfig
from qgis.core import QgsApplication, QgsProcessingException

from qgis_plugin import environment
from qgis_plugin.algorithms import set_up
from qgis_plugin.environment import EnvironmentMissing, use_interpreter, worker_python
from qgis_plugin.layout import REQUIREMENTS, ROOT

#: A Python in shell. As an interpreter it makes environments that hold itself; what it is asked goes to a file.
PYTHON = r"""
here=$(dirname "$0")
echo "$* | $PYTHONPATH" >> "{log}"
case "$*" in
  *"-m venv "*) {venv} ; for folder; do :; done; mkdir -p "$folder/bin"; cp "$0" "$folder/bin/python"; echo "made it" ;;
  *"-m pip "*) {pip} ; echo "Successfully installed things" ;;
  *requirements.txt) {libraries} ; echo "numpy 2.0" ;;
  *check_python.py) {able} ; echo "Python 3.12.1" ;;
  *"polymerge_core env"*) {core} ; echo "polymerge_core 0.1.0" ;;
  *) echo "asked for something else: $*"; exit 9 ;;
esac
"""


@pytest.fixture
def log(tmp_path) -> Path:
    return tmp_path / "log"


@pytest.fixture
def python(script, log):
    """Return a function that makes such a Python; each step can be given shell to run first."""

    def make(name="python3.12", **steps):
        parts = dict.fromkeys(("venv", "pip", "libraries", "able", "core"), ":")
        return script(PYTHON.format(log=log, **{**parts, **steps}), name)

    return make


def asked(log: Path) -> list[str]:
    return [line.split(" | ")[0] for line in log.read_text().splitlines()]


class TestMaking:
    def test_checks_makes_installs_and_tries(self, run, python, log, feedback, own_profile):
        own = python()
        found = run("setup", PYTHON=own)["INTERPRETER"]
        assert found == worker_python()
        assert own_profile in Path(found).parents
        kinds = ("venv", "pip", "requirements.txt", "env", "check_python.py")
        assert [next(kind for kind in kinds if f"{kind} " in f"{each} ") for each in asked(log)] == [
            "check_python.py",
            "venv",
            "pip",
            "requirements.txt",
            "env",
        ]
        assert feedback.console == [
            "Python 3.12.1",
            "made it",
            "Successfully installed things",
            "numpy 2.0",
            "polymerge_core 0.1.0",
        ]
        assert feedback.infos[-1] == f"PolyMerge is ready. It runs in {found}"

    def test_shows_each_step_and_goes_forward_to_the_end(self, run, python, feedback):
        run("setup", PYTHON=python())
        assert [text.split()[0] for text in feedback.texts] == ["Looking", "Making", "Installing", "Trying"]
        assert feedback.progresses == sorted(feedback.progresses)
        assert feedback.progresses[-1] == 100

    def test_installs_wheels_only_from_pypi_with_the_plugin_s_requirements(self, run, python, log, feedback):
        run("setup", PYTHON=python())
        command = asked(log)[2]
        assert " -m pip install " in command
        assert f"--requirement={REQUIREMENTS}" in command
        assert "--only-binary=:all:" in command
        assert "--no-input" in command
        assert "--no-index" not in command
        assert "Installing the libraries from PyPI" in feedback.texts

    def test_with_a_folder_of_wheels_needs_no_network(self, run, python, log, tmp_path, feedback):
        run("setup", PYTHON=python(), WHEELS=str(tmp_path))
        assert f" --no-index --find-links={tmp_path} " in asked(log)[2]
        assert f"Installing the libraries from {tmp_path}" in feedback.texts

    def test_the_interpreter_is_run_isolated_and_the_core_is_found_in_the_plugin(self, run, python, log, monkeypatch):
        monkeypatch.setenv("PYTHONPATH", "/foreign")
        run("setup", PYTHON=python())
        assert {line.split(" | ")[1] for line in log.read_text().splitlines()} == {str(ROOT)}
        assert all(command.startswith("-I ") for command in asked(log)[:2])

    def test_replaces_an_older_environment_and_a_named_interpreter(self, run, python):
        own = python()
        first = run("setup", PYTHON=own)["INTERPRETER"]
        use_interpreter(own)
        second = run("setup", PYTHON=own)["INTERPRETER"]
        assert worker_python() == second != first
        assert not Path(first).exists()
        assert ProcessingConfig.getSetting(environment.SETTING) == ""


class TestMakingFails:
    @pytest.fixture
    def old(self, run, python):
        """The interpreter of an environment that was made before."""
        return run("setup", PYTHON=python("python3.11"))["INTERPRETER"]

    @pytest.mark.parametrize(
        ("step", "shell", "message"),
        [
            (
                "able",
                "echo 'it is Python 3.9.1, and more is needed'; exit 1",
                "(it is Python 3.9.1, and more is needed): choose another",
            ),
            ("able", "exit 1", "cannot make an environment (it says nothing): choose another Python."),
            ("venv", "echo 'No space left on device'; exit 1", "cannot make an environment (No space left on device)."),
            (
                "pip",
                "echo Collecting; echo 'ERROR: Not found'; echo 'ERROR: No matching distribution'; echo hint; exit 1",
                "cannot install the libraries (ERROR: No matching distribution): check the network",
            ),
            ("pip", "echo 'No module named pip'; exit 1", "cannot install the libraries (No module named pip)"),
            ("libraries", "echo 'numpy is missing'; exit 1", "cannot run PolyMerge (numpy is missing)"),
            ("core", "echo 'ImportError: libGL.so.1'; exit 1", "cannot run PolyMerge (ImportError: libGL.so.1)"),
        ],
    )
    def test_says_why_and_keeps_the_old_one(self, run, python, own_profile, old, step, shell, message):
        before = sorted(own_profile.iterdir())
        with pytest.raises(QgsProcessingException) as told:
            run("setup", PYTHON=python(**{step: shell}))
        assert message in str(told.value)
        assert worker_python() == old
        assert sorted(own_profile.iterdir()) == before

    def test_of_a_program_that_is_killed_gives_its_last_words(self, run, python):
        with pytest.raises(QgsProcessingException, match="Collecting numpy"):
            run("setup", PYTHON=python(pip="echo Collecting numpy; kill -9 $$"))

    @pytest.mark.parametrize("kind", ["nothing", "folder"])
    def test_of_what_is_no_file_says_so(self, run, tmp_path, kind):
        path = tmp_path / kind
        if kind == "folder":
            path.mkdir()
        with pytest.raises(QgsProcessingException, match=r"there is no such file\): choose another Python"):
            run("setup", PYTHON=str(path))

    def test_of_what_cannot_be_started_says_why(self, run, tmp_path):
        file = tmp_path / "python"
        file.touch(mode=0o644)
        with pytest.raises(QgsProcessingException) as told:
            run("setup", PYTHON=str(file))
        assert "(?)" not in str(told.value)
        assert str(told.value).startswith(f"{file} cannot make an environment (")

    def test_without_a_python_asks_for_one(self, run, monkeypatch):
        monkeypatch.setattr(set_up, "likely_python", lambda: "")  # what QGIS takes for an empty parameter
        with pytest.raises(QgsProcessingException, match="No Python is named"):
            run("setup", PYTHON="")

    def test_by_a_cancel_stops_within_a_second_and_keeps_the_old_one(self, run, python, own_profile, old, feedback):
        before = sorted(own_profile.iterdir())
        moments = []

        def cancel():
            moments.append(time.monotonic())
            feedback.cancel()

        timer = threading.Timer(0.5, cancel)
        timer.start()
        with pytest.raises(QgsProcessingException, match="Cancelled; the environment is as it was before"):
            run("setup", PYTHON=python(pip="echo Downloading; exec sleep 60"))
        assert time.monotonic() - moments[0] < 1.5
        assert worker_python() == old
        assert sorted(own_profile.iterdir()) == before


class TestUsingAsIs:
    def test_checks_it_and_names_it_in_the_settings(self, run, python, log, own_profile):
        own = python()
        assert run("setup", PYTHON=own, USE_AS_IS=True) == {"INTERPRETER": own}
        assert worker_python() == own
        assert ProcessingConfig.getSetting(environment.SETTING) == own
        assert len(asked(log)) == 2
        assert not own_profile.exists()

    def test_one_that_lacks_libraries_is_refused_and_not_named(self, run, python):
        with pytest.raises(QgsProcessingException, match=r"\(numpy is missing\): install what is missing"):
            run("setup", PYTHON=python(libraries="echo 'numpy is missing'; exit 1"), USE_AS_IS=True)
        with pytest.raises(EnvironmentMissing, match="no Python environment yet"):
            worker_python()

    def test_a_real_one_is_taken(self, run, interpreter, feedback):
        assert run("setup", PYTHON=interpreter, USE_AS_IS=True)["INTERPRETER"] == interpreter
        assert any(line.startswith("polymerge_core ") for line in feedback.console)
        assert any(line.startswith("shapely ") for line in feedback.console)


class TestOnlyChecking:
    def test_without_an_environment_says_what_to_do(self, run, python, own_profile):
        with pytest.raises(QgsProcessingException, match=r"no Python environment yet: run “Set up PolyMerge”"):
            run("setup", CHECK_ONLY=True, PYTHON=python())
        assert not own_profile.exists()

    def test_looks_at_the_one_that_is_used_and_changes_nothing(self, run, python, log):
        own = python()
        use_interpreter(own)
        other = python("other")
        assert run("setup", CHECK_ONLY=True, PYTHON=other, USE_AS_IS=True)["INTERPRETER"] == own
        assert worker_python() == own
        assert [("check_python.py" in each, "env" in each) for each in asked(log)] == [(True, False), (False, True)]

    def test_says_what_is_missing(self, run, python):
        use_interpreter(python(libraries="echo 'shapely 1.8 is older than 2.1'; exit 1"))
        with pytest.raises(QgsProcessingException, match=r"\(shapely 1.8 is older than 2.1\)"):
            run("setup", CHECK_ONLY=True)


class TestParameters:
    def test_the_likely_python_is_offered(self, monkeypatch, provider):
        monkeypatch.setattr(set_up, "likely_python", lambda: "/likely/python")
        algorithm = QgsApplication.processingRegistry().algorithmById("polymerge:setup").create()
        assert algorithm.parameterDefinition("PYTHON").defaultValue() == "/likely/python"

    def test_a_program_without_an_extension_can_be_chosen(self, provider, context):
        algorithm = QgsApplication.processingRegistry().algorithmById("polymerge:setup")
        assert algorithm.checkParameterValues({"PYTHON": "/usr/bin/python3.12"}, context) == (True, "")

    def test_can_run_without_an_environment(self, provider):
        can, _ = QgsApplication.processingRegistry().algorithmById("polymerge:setup").canExecute()
        assert can


def test_note_is_readable_by_a_person(run, python, own_profile):
    run("setup", PYTHON=python())
    assert set(json.loads((own_profile / "made.json").read_text())) == {"folder", "requirements", "made_with"}
