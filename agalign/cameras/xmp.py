"""XMP packets: reading and changing values by namespace, in any of the forms that cameras write."""

import re
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from agalign.values.text import without_controls

Name = tuple[str, str]
"""(namespace, name). A namespace is its URI without scheme, `www.`, version and final slash, which differ between
versions of firmware: `micasense.com/DLS`, or only the start of its path, `micasense.com`.
"""


def names_in(namespace: str, names: str) -> frozenset[Name]:
    """Return these names, separated by spaces, in one namespace."""
    return frozenset((namespace, name) for name in names.split())


_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_MAX_DEPTH = 50
"""Limit of nested elements, which protects the recursive XML library, and of the parts of a namespace; cameras write
six and three.
"""
_NAMESPACES = threading.Lock()


@dataclass(frozen=True)
class Packet:
    """One XMP packet; an empty one has no root."""

    root: Element | None = None
    prefixes: tuple[tuple[str, str], ...] = ()
    """(prefix, namespace URI) as they were read."""

    @classmethod
    def parse(cls, packet: Any) -> "Packet":
        """Parse bytes or text. A malformed packet becomes an empty one, because the image may still be good."""
        text = packet.decode("utf-8", "replace") if isinstance(packet, bytes) else packet
        max_length = 1 << 22  # cameras write a few thousand characters
        if not isinstance(text, str) or len(text) > max_length:
            return cls()
        start, end = text.find("<x:xmpmeta"), text.rfind("</x:xmpmeta>")
        if start < 0 or end < 0:
            return cls()
        text = text[start : end + len("</x:xmpmeta>")]
        try:
            root = fromstring(text)
        except (ParseError, DefusedXmlException, ValueError):
            return cls()
        if _is_deeper(root, _MAX_DEPTH):
            return cls()
        prefixes = re.findall(r"""xmlns:([A-Za-z_][\w.-]*)\s*=\s*["']([^"']+)["']""", text)
        return cls(root, tuple(p for p in prefixes if not re.fullmatch(r"ns\d+", p[0])))

    def values(self) -> dict[Name, tuple[str, ...]]:
        """Return {(namespace, name): values} of all rdf:Description elements; the first of two values is used.

        A value has a key for its namespace and one for each start of its path.
        """
        result: dict[Name, tuple[str, ...]] = {}
        for description in self._descriptions():
            attributes = [(tag, (value,)) for tag, value in description.attrib.items()]
            for tag, raw in [*attributes, *((child.tag, _texts(child)) for child in description)]:
                cleaned = tuple(without_controls(v).strip() for v in raw)
                for name in _names(tag) if any(cleaned) else ():
                    result.setdefault(name, cleaned)
        return result

    def remove(self, names: Collection[Name]) -> None:
        """Remove values."""
        for description in self._descriptions():
            for tag in [t for t in description.attrib if _is_one_of(t, names)]:
                del description.attrib[tag]
            for child in [c for c in description if _is_one_of(c.tag, names)]:
                description.remove(child)

    def take(self, other: "Packet", names: Collection[Name]) -> None:
        """Replace the values with these names by those of another packet, which may have none."""
        self.remove(names)
        mine = next(self._descriptions(), None)
        if mine is None:
            return
        for description in other._descriptions():
            mine.attrib.update({t: v for t, v in description.attrib.items() if _is_one_of(t, names)})
            mine.extend(deepcopy(child) for child in description if _is_one_of(child.tag, names))

    def put(self, name: Name, values: Sequence[str]) -> None:
        """Change an existing value, in its existing form: attribute, element or sequence."""
        for description in self._descriptions():
            for tag in [t for t in description.attrib if _is_one_of(t, [name])]:
                description.attrib[tag] = ",".join(values)
            for child in [c for c in description if _is_one_of(c.tag, [name])]:
                _put_texts(child, values)

    def add(self, name: Name, value: str) -> None:
        """Add or replace a value, in a namespace that the packet already uses; else nothing is changed."""
        self.remove([name])
        for description in self._descriptions():
            for tag in [*description.attrib, *(child.tag for child in description)]:
                uri, _, _ = tag.removeprefix("{").rpartition("}")
                if name[0] in _namespaces(uri):
                    ElementTree.SubElement(description, f"{{{uri}}}{name[1]}").text = value
                    return

    def serialised(self) -> bytes:
        """Return the bytes of the packet for a file; empty for an empty packet."""
        if self.root is None:
            return b""
        with _registered(self.prefixes):
            body = ElementTree.tostring(self.root, encoding="unicode")
        head, tail = '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>', '<?xpacket end="w"?>'
        return f"{head}\n{body}\n{tail}".encode()

    def _descriptions(self) -> Iterator[Element]:
        return iter(()) if self.root is None else self.root.iter(f"{_RDF}Description")


@contextmanager
def _registered(prefixes: Sequence[tuple[str, str]]) -> Iterator[None]:
    """Serialise with these prefixes. ElementTree has one global table of prefixes, which is restored afterwards so that
    the prefixes of one file are not used for another.
    """
    table: dict[str, str] = vars(ElementTree)["_namespace_map"]
    with _NAMESPACES:
        before = dict(table)
        try:
            for prefix, uri in prefixes:
                ElementTree.register_namespace(prefix, uri)
            yield
        finally:
            table.clear()
            table.update(before)


def _is_deeper(root: Element, depth: int) -> bool:
    level = [root]
    for _ in range(depth):
        level = [child for element in level for child in element]
    return bool(level)


def _texts(element: Element) -> tuple[str, ...]:
    items = [item.text or "" for item in element.iter(f"{_RDF}li")]
    return tuple(items) if items else (element.text or "",)


def _put_texts(element: Element, values: Sequence[str]) -> None:
    """Set the items of a sequence if their number agrees, else one text with the values joined by commas."""
    items = list(element.iter(f"{_RDF}li"))
    if items and len(items) == len(values):
        for item, value in zip(items, values, strict=True):
            item.text = value
    else:
        (items[0] if items else element).text = ",".join(values)


@lru_cache(maxsize=4096)  # all files of a camera have the same tags
def _names(tag: str) -> tuple[Name, ...]:
    """The keys of an XML tag '{uri}name'; none for RDF's own namespaces and without a namespace."""
    uri, _, name = tag.removeprefix("{").rpartition("}")
    return tuple((namespace, name) for namespace in _namespaces(uri))


def _is_one_of(tag: str, names: Collection[Name]) -> bool:
    return any(name in names for name in _names(tag))


def _namespaces(uri: str) -> list[str]:
    if uri.startswith("http://www.w3.org/"):
        return []
    scheme_and_version = r"^https?://(?:www\.)?|(?:/\d+(?:\.\d+)*)?/?$"
    path = re.sub(scheme_and_version, "", uri, flags=re.IGNORECASE)
    parts = path.split("/")[:_MAX_DEPTH]
    return ["/".join(parts[:count]) for count in range(len(parts), 0, -1)] if path else []
