"""The checked-in protobuf code is what the schema says, and the schema keeps its rules of change."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto

from protocols.messages import syncline_pb2 as pb
from protocols.topics import TOPICS
from protocols.validation.codec import message_class
from tests.generate_messages import MESSAGES, generate


def serialised_descriptor(module: Path) -> bytes:
    """The serialised file descriptor in a generated module: its one call of AddSerializedFile."""
    calls = [
        node.args[0]
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "AddSerializedFile"
    ]
    assert len(calls) == 1
    value = ast.literal_eval(calls[0])
    assert isinstance(value, bytes)
    return value


def test_generated_code_is_what_the_schema_says(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools")
    generate(tmp_path)
    fresh = FileDescriptorProto.FromString(serialised_descriptor(tmp_path / "syncline_pb2.py"))
    ours = FileDescriptorProto.FromString(serialised_descriptor(MESSAGES / "syncline_pb2.py"))
    assert ours == fresh, "protocols/messages is out of date: run make proto"


def test_type_stub_is_what_the_schema_says(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools")
    generate(tmp_path)

    def fields(stub: Path) -> set[str]:
        tree = ast.parse(stub.read_text(encoding="utf-8"))
        return {
            f"{group.name}.{ast.unparse(node)}"
            for group in ast.walk(tree)
            if isinstance(group, ast.ClassDef)
            for node in group.body
            if isinstance(node, ast.AnnAssign)
        }

    assert fields(MESSAGES / "syncline_pb2.pyi") == fields(tmp_path / "syncline_pb2.pyi")


def test_every_topic_has_a_message_with_a_schema_version_as_field_one() -> None:
    for topic in TOPICS:
        field = message_class(topic).DESCRIPTOR.fields_by_name["schema_version"]
        assert field.number == 1, topic.name


def test_every_message_belongs_to_the_first_package() -> None:
    assert pb.DESCRIPTOR.package == "syncline.v1"
