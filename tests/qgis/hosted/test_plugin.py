"""Loading and unloading, and what the provider says of itself."""

from __future__ import annotations

import configparser
import gc
import weakref
from pathlib import Path

import pytest
from processing.core.ProcessingConfig import ProcessingConfig, Setting
from qgis.core import QgsApplication, QgsSettings
from qgis.PyQt import sip

from qgis_plugin import classFactory
from qgis_plugin.environment import SETTING
from qgis_plugin.layout import ROOT
from qgis_plugin.provider import PolyMergeProvider

IDS = {
    "setup",
    "projectlocalmaps",
    "mergelocalmaps",
    "mergenetwork",
    "evaluatemap",
    "updatemap",
    "mapchanges",
    "undoupdate",
}


def registered():
    return QgsApplication.processingRegistry().providerById("polymerge")


class TestLoading:
    @pytest.mark.parametrize("iface", [None, object()], ids=["qgis_process", "desktop"])
    @pytest.mark.parametrize("start", ["initProcessing", "initGui"])
    def test_adds_the_provider_with_all_algorithms(self, iface, start):
        plugin = classFactory(iface)
        assert registered() is None
        getattr(plugin, start)()
        try:
            assert {each.name() for each in registered().algorithms()} == IDS
        finally:
            plugin.unload()

    def test_unloading_takes_the_provider_and_its_setting_away(self):
        plugin = classFactory(None)
        plugin.initProcessing()
        assert SETTING in ProcessingConfig.settings
        plugin.unload()
        assert registered() is None
        assert SETTING not in ProcessingConfig.settings
        assert QgsApplication.processingRegistry().algorithmById("polymerge:mergelocalmaps") is None

    def test_unloading_what_was_never_loaded_does_nothing(self):
        classFactory(None).unload()

    def test_unloading_twice_does_nothing(self):
        plugin = classFactory(None)
        plugin.initProcessing()
        plugin.unload()
        plugin.unload()

    def test_loading_again_after_unloading_works(self):
        plugin = classFactory(None)
        for _ in range(3):
            plugin.initProcessing()
            assert {each.name() for each in registered().algorithms()} == IDS
            plugin.unload()
        assert registered() is None

    def test_a_second_plugin_in_one_qgis_is_unloaded_without_an_error(self):
        first, second = classFactory(None), classFactory(None)
        first.initProcessing()
        try:
            second.initProcessing()
            second.unload()
            assert registered() is not None
        finally:
            first.unload()
        assert registered() is None

    def test_a_setting_of_the_session_before_is_there_again(self, tmp_path):
        QgsSettings().setValue(f"Processing/Configuration/{SETTING}", str(tmp_path))
        plugin = classFactory(None)
        plugin.initProcessing()
        try:
            assert ProcessingConfig.getSetting(SETTING) == str(tmp_path)
        finally:
            plugin.unload()


class TestProvider:
    def test_is_the_python_object_that_keeps_the_styles(self, provider):
        assert isinstance(provider, PolyMergeProvider)

    def test_id_never_changes(self, provider):
        assert provider.id() == "polymerge"

    def test_long_name_ends_with_the_version_of_the_metadata(self, provider):
        parser = configparser.ConfigParser(interpolation=None)
        parser.read(ROOT / "metadata.txt", encoding="utf-8")
        assert provider.name() == parser["general"]["name"]
        assert provider.longName() == f"PolyMerge {parser['general']['version']}"

    def test_has_an_icon_that_can_be_drawn(self, provider):
        assert not provider.icon().pixmap(24, 24).isNull()
        assert Path(provider.svgIconPath()).is_file()

    def test_has_a_file_setting_under_its_name_with_its_icon(self, provider):
        setting = ProcessingConfig.settings[SETTING]
        assert (setting.group, setting.valuetype, setting.value) == ("PolyMerge", Setting.FILE, "")
        assert "Set up PolyMerge" in setting.description
        assert not ProcessingConfig.getGroupIcon("PolyMerge").isNull()

    def test_a_style_outlives_the_run_that_asked_for_it(self, provider):
        there = weakref.ref(provider.style("merged_map"))
        gc.collect()
        assert there() is not None
        provider.style("lineage")
        assert there() is not None

    def test_a_style_that_qgis_has_deleted_is_forgotten_and_asked_for_anew(self, provider):
        first = provider.style("merged_map")
        there = weakref.ref(first)
        sip.delete(first)
        del first
        assert not sip.isdeleted(provider.style("merged_map"))
        gc.collect()
        assert there() is None
