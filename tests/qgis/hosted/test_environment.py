"""Which Python the worker runs in, in each state that a profile can be in."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from processing.core.ProcessingConfig import ProcessingConfig
from qgis.core import QgsApplication, QgsSettings

from qgis_plugin import environment
from qgis_plugin.environment import (
    SETTING,
    EnvironmentMissing,
    interpreter_of,
    is_program,
    likely_python,
    new_environment,
    requirements,
    use_interpreter,
    worker_python,
)

ENVIRONMENTS = environment.environments  # each test has another one

pytestmark = pytest.mark.usefixtures("provider")


def fill(folder: Path) -> str:
    """Put something that looks like an interpreter into an environment."""
    python = Path(interpreter_of(folder))
    python.parent.mkdir(parents=True)
    python.write_text("#!/bin/sh\n")
    python.chmod(0o755)
    return str(python)


@pytest.fixture
def made(own_profile) -> str:
    """An environment in the profile; its interpreter."""
    with new_environment(sys.executable) as folder:
        return fill(folder)


class TestWorkerPython:
    def test_without_an_environment_says_what_to_do(self):
        with pytest.raises(EnvironmentMissing, match=r"no Python environment yet: run “Set up PolyMerge”"):
            worker_python()

    def test_is_the_one_that_was_made(self, made):
        assert worker_python() == made

    def test_is_rather_the_one_that_the_user_named(self, made, script):
        own = script("exit 0")
        use_interpreter(own)
        assert worker_python() == own
        use_interpreter("")
        assert worker_python() == made

    def test_a_named_one_that_is_gone_is_told_and_not_replaced_by_another(self, made, script):
        own = script("exit 0")
        use_interpreter(own)
        Path(own).unlink()
        with pytest.raises(EnvironmentMissing) as told:
            worker_python()
        assert str(told.value).startswith(f"{own} is not there")
        assert "Set up PolyMerge" in str(told.value)

    def test_a_named_one_that_is_a_folder_or_no_program_is_told(self, tmp_path):
        (tmp_path / "text").write_text("")
        for wrong in (tmp_path, tmp_path / "text"):
            use_interpreter(str(wrong))
            with pytest.raises(EnvironmentMissing, match="is not there"):
                worker_python()

    def test_one_that_was_made_for_other_libraries_is_told(self, made, own_profile):
        note = json.loads((own_profile / "made.json").read_text())
        note["requirements"] = [*note["requirements"][1:], "numpy>=0.1"]
        (own_profile / "made.json").write_text(json.dumps(note))
        with pytest.raises(EnvironmentMissing, match=r"another version of it: run “Set up PolyMerge” again"):
            worker_python()

    def test_one_whose_interpreter_is_gone_is_as_none(self, made):
        Path(made).unlink()
        with pytest.raises(EnvironmentMissing, match="no Python environment yet"):
            worker_python()

    @pytest.mark.parametrize("note", ["", "{", "null", "5", "[1]", '"folder"', "{}", '{"folder": 5}', "\udcff"])
    def test_a_damaged_note_is_as_none(self, made, own_profile, note):
        (own_profile / "made.json").write_bytes(note.encode("utf-8", errors="surrogateescape"))
        with pytest.raises(EnvironmentMissing, match="no Python environment yet"):
            worker_python()


class TestUseInterpreter:
    def test_is_kept_for_the_next_session(self, script):
        own = script("exit 0")
        use_interpreter(own)
        assert QgsSettings().value(f"Processing/Configuration/{SETTING}") == own
        ProcessingConfig.settings[SETTING].value = ""
        ProcessingConfig.readSettings()
        assert worker_python() == own


class TestNewEnvironment:
    def test_replaces_the_old_one_and_removes_it(self, made, own_profile):
        with new_environment(sys.executable) as folder:
            python = fill(folder)
            assert worker_python() == made
        assert worker_python() == python
        assert not Path(made).exists()
        assert sorted(each.name for each in own_profile.iterdir()) == sorted([folder.name, "made.json"])

    @pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
    def test_that_fails_leaves_the_old_one_and_no_trace(self, made, own_profile, error):
        before = sorted(each.name for each in own_profile.iterdir())
        with pytest.raises(error), new_environment(sys.executable):
            raise error
        assert worker_python() == made
        assert sorted(each.name for each in own_profile.iterdir()) == before

    def test_that_cannot_be_noted_leaves_the_old_one(self, made, own_profile, monkeypatch):
        before = sorted(each.name for each in own_profile.iterdir())

        def refuse(*_arguments, **_options):
            raise OSError("the disk is full")

        monkeypatch.setattr(Path, "write_text", refuse)
        with pytest.raises(OSError, match="disk is full"), new_environment(sys.executable):
            pass
        assert worker_python() == made
        assert sorted(each.name for each in own_profile.iterdir()) == before

    def test_lies_in_the_profile_and_not_in_the_plugin(self):
        profile = Path(QgsApplication.qgisSettingsDirPath())
        assert ENVIRONMENTS().parent == profile
        assert "plugins" not in ENVIRONMENTS().parts

    def test_is_noted_with_the_requirements_of_the_plugin(self, made, own_profile):
        note = json.loads((own_profile / "made.json").read_text(encoding="utf-8"))
        assert note["requirements"] == requirements()
        assert all(">=" in each for each in requirements())
        assert (own_profile / note["folder"]) in Path(made).parents


class TestInterpreterOf:
    @pytest.mark.parametrize(("system", "parts"), [("posix", ("bin", "python")), ("nt", ("Scripts", "python.exe"))])
    def test_lies_where_the_system_has_it(self, monkeypatch, tmp_path, system, parts):
        folder = tmp_path / "environment"
        monkeypatch.setattr(environment.os, "name", system)
        found = interpreter_of(folder)
        monkeypatch.undo()
        assert found == str(folder.joinpath(*parts))


class TestIsProgram:
    def test_needs_a_file_that_may_be_run(self, tmp_path, script):
        file = tmp_path / "file"
        file.touch(mode=0o644)
        assert is_program(script("exit 0"))
        assert not is_program(str(file))
        assert not is_program(str(tmp_path))
        assert not is_program(str(tmp_path / "nothing"))


class TestLikelyPython:
    def test_is_the_one_whose_libraries_qgis_uses(self, tmp_path, monkeypatch):
        own = tmp_path / "bin" / f"python3.{sys.version_info.minor}"
        own.parent.mkdir()
        own.touch(mode=0o755)
        monkeypatch.setattr(sys, "exec_prefix", str(tmp_path))
        monkeypatch.setattr(environment.shutil, "which", lambda name: f"/path/{name}")
        assert likely_python() == str(own)

    def test_is_the_newest_of_the_path_where_qgis_s_own_is_too_old(self, tmp_path, monkeypatch):
        own = tmp_path / "bin" / "python3.9"
        own.parent.mkdir()
        own.touch(mode=0o755)
        monkeypatch.setattr(sys, "exec_prefix", str(tmp_path))
        monkeypatch.setattr(sys, "version_info", type("V", (tuple,), {"minor": 9})((3, 9, 18)))
        present = {"python3.10", "python3.12", "python3"}
        monkeypatch.setattr(environment.shutil, "which", lambda name: f"/path/{name}" if name in present else None)
        assert likely_python() == "/path/python3.12"

    def test_is_empty_where_there_is_none(self, tmp_path, monkeypatch):
        monkeypatch.setattr(sys, "exec_prefix", str(tmp_path))
        monkeypatch.setattr(environment.shutil, "which", lambda _name: None)
        assert likely_python() == ""

    def test_is_never_the_program_that_qgis_is(self, monkeypatch):
        monkeypatch.setattr(sys, "executable", "/usr/bin/qgis")
        assert likely_python() != "/usr/bin/qgis"
