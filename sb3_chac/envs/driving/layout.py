"""Layout of an observation: which of its numbers are what."""

from collections.abc import Iterable
from typing import Any


def placed(parts: Iterable[tuple[str, int, str, str]]) -> list[dict[str, Any]]:
    """
    Number the parts of an observation.

    :param parts: name, size, unit and meaning of each, in their order
    :return: of each its name, first element, element after the last, unit and meaning
    """
    result, start = [], 0
    for name, size, unit, meaning in parts:
        result.append({"name": name, "start": start, "stop": start + size, "unit": unit, "meaning": meaning})
        start += size
    return result
