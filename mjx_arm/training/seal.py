"""JSON texts that carry a digest of themselves, so that any change of them is found."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any

_DIGEST = re.compile(r'"([0-9a-f]{64})"\s*\}\s*\Z')


def seal(content: Mapping[str, Any]) -> str:
    """JSON of `content`, and last a member `sha256`: the digest of the text without it."""
    text = json.dumps({**content, "sha256": ""}, indent=2) + "\n"
    head, _, tail = text.rpartition('""')
    return f'{head}"{_digest(text)}"{tail}'


def is_sealed(text: str) -> bool:
    """Whether a text is as `seal` made it."""
    found = _DIGEST.search(text)
    if found is None:
        return False
    return found[1] == _digest(f'{text[: found.start()]}""{text[found.end(1) + 1 :]}')


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
