"""Decoders of the format's maintainers, message by message; each is loaded by the logs that need it."""

from __future__ import annotations

import json
from decimal import Decimal
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from mcap.records import Channel, Schema


def ros2_decoder(schema: Schema | None) -> Callable[[bytes], Any]:
    """Return the decoder of ROS 2 messages; ``ValueError`` if it cannot read the definition."""
    from mcap_ros2.decoder import DecoderFactory  # noqa: PLC0415  (few logs need it)

    decoder = DecoderFactory().decoder_for("cdr", schema)
    if decoder is None:
        raise ValueError("the official decoder does not know its definition")
    return decoder


def object_decoder(channel: Channel, schema: Schema | None) -> Callable[[bytes], Any]:
    """Return the decoder of protobuf or JSON messages."""
    if channel.message_encoding == "json":
        return lambda payload: json.loads(payload.decode("utf-8"), parse_float=Decimal)
    from mcap_protobuf.decoder import DecoderFactory  # noqa: PLC0415  (few logs need it)

    decoder = DecoderFactory().decoder_for("protobuf", schema)
    if decoder is None:
        raise ValueError("the official decoder does not know it")
    return decoder
