"""Names of cameras: one rule, and an injective derivation of bus-key segments from it."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import pytest

from protocols.bus.security.access import access_rules, certificate_name, certificate_owner
from protocols.core.errors import InputError
from protocols.core.names import MAX_SEGMENT, check_name, is_name, key_segment, name_from_file, name_of_segment
from tests.support.command_line import assert_reported


@pytest.mark.parametrize(
    ("name", "segment"),
    [
        ("cam0", "cam0"),
        ("left_front-2", "left_front-2"),
        ("x" * 63, "x" * 63),
        ("CVLab1", "CVLab1"),
        ("GoPro 2", "GoPro%202"),
        ("Kamera.Süd", "Kamera%2ES%C3%BCd"),
        ("ሀ" * 63, "%E1%88%80" * 63),
        ("カメラ", "%E3%82%AB%E3%83%A1%E3%83%A9"),
    ],
)
def test_a_name_has_a_readable_key_segment_and_is_recovered_from_it(name: str, segment: str) -> None:
    assert check_name(name) == name
    assert key_segment(name) == segment
    assert name_of_segment(segment) == name


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("", "is empty"),
        (".", "full stop"),
        ("..", "full stop"),
        (".hidden", "full stop"),
        ("cam0 ", "space"),
        (" cam0", "space"),
        ("a/b", "'/'"),
        ("a\\b", "not allowed"),
        ("a\nb", "not allowed"),
        ("a\x00", "not allowed"),
        ("a\u200bb", "not allowed"),
        ("a\u202eb", "not allowed"),
        ("cam*", "'*'"),
        ("cam?", "'?'"),
        ("a%20b", "'%'"),
        ("a,b", "','"),
        ('a"b', "not allowed"),
        ("metadata", "reserved"),
        ("x" * 64, "64 characters"),
        ("𐐀" * 63, "252 bytes"),
        ("\u0301a", "combining mark"),
        ("\ud800", "not allowed"),
        (unicodedata.normalize("NFD", "Süd"), "composed form"),
    ],
)
def test_a_bad_name_is_refused_in_one_line(name: str, word: str) -> None:
    assert not is_name(name)
    assert_reported(lambda: check_name(name, file=Path("rig.toml"), line=3), Path("rig.toml"), 3, "camera name ", word)
    with pytest.raises(InputError):
        key_segment(name)


@pytest.mark.parametrize(
    "segment",
    ["", "%", "%2", "%63am0", "GoPro%2", "a%2fb", "a%2Fb", "S%C3%bcd", "%FF", "a.b", "a b", "ü", "*"],
)
def test_a_segment_that_no_name_has_gives_no_name(segment: str) -> None:
    """Also a second spelling of a valid name: access rules compare segments."""
    assert name_of_segment(segment) is None


def test_a_segment_is_bounded() -> None:
    assert len(key_segment("ü" * 63)) <= MAX_SEGMENT
    assert name_of_segment("%C3%BC" * 1000) is None


def test_a_file_name_in_decomposed_form_names_the_camera_in_composed_form() -> None:
    assert name_from_file(unicodedata.normalize("NFD", "Kamera.Süd")) == "Kamera.Süd"


def test_the_owner_of_a_certificate_is_found_for_every_name_and_generation() -> None:
    for name in ("cam0", "Kamera.Süd", "GoPro 2"):
        owner = f"camera.{key_segment(name)}"
        assert certificate_owner(certificate_name("camera", name)) == owner
        assert certificate_owner(certificate_name("camera", name, 3)) == owner
    with pytest.raises(InputError, match="too long for a certificate"):
        certificate_name("camera", "ü" * 30)


def test_access_rules_use_the_key_segment() -> None:
    rules = access_rules("site", [("camera", "GoPro 2")])["rules"]
    own = next(rule for rule in rules if rule["id"].startswith("own-"))
    assert "syncline/site/camera/GoPro%202/**" in own["key_exprs"]
    assert "syncline/site/agent/GoPro%202/**" in own["key_exprs"]
