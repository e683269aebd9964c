"""What `qgis_process` says of the plugin: its algorithms, and a help for each parameter."""

from __future__ import annotations

import pytest

from tests.qgis.process.running import Qgis

ALGORITHMS = {
    "mergelocalmaps": "Merge local maps",
    "mergenetwork": "Merge network",
    "evaluatemap": "Evaluate map",
    "mapchanges": "Changes of a map",
    "undoupdate": "Undo update of a map",
    "projectlocalmaps": "Project local maps",
    "setup": "Set up PolyMerge",
    "updatemap": "Update map",
}


def test_an_installed_plugin_lists_its_algorithms(fresh: Qgis) -> None:
    listed = fresh.call("--json", "list")

    provider = listed.answer["providers"]["polymerge"]
    assert {name: each["name"] for name, each in provider["algorithms"].items()} == {
        f"polymerge:{name}": title for name, title in ALGORITHMS.items()
    }
    assert provider["name"] == "PolyMerge"


@pytest.mark.parametrize("name", ALGORITHMS)
def test_each_parameter_of_an_algorithm_is_explained(fresh: Qgis, name: str) -> None:
    told = fresh.call("--json", "help", f"polymerge:{name}")

    parameters = told.answer["parameters"]
    assert parameters
    assert [each for each, about in parameters.items() if not about["help"] or not about["description"]] == []
    assert told.answer["algorithm_details"]["short_description"]
    assert told.answer["algorithm_details"]["help_url"].startswith("https://")
    assert told.answer["algorithm_details"]["can_cancel"]
