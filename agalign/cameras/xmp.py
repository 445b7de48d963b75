"""XMP packets: values by namespace, in whatever form a camera wrote them, and changes to them."""

import re
from collections.abc import Collection, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

Namespace = Literal["Camera", "MicaSense", "DLS", "drone-dji", "Sentera"]
Name = tuple[Namespace, str]

_NAMESPACES: dict[str, Namespace] = {
    "http://pix4d.com/camera/1.0": "Camera",
    "http://pix4d.com/1.0": "Camera",
    "http://micasense.com/MicaSense/1.0": "MicaSense",
    "http://micasense.com/DLS/1.0": "DLS",
    "http://www.dji.com/drone-dji/1.0": "drone-dji",
}
_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_PREFIX = re.compile(r"""xmlns:([A-Za-z_][\w.-]*)\s*=\s*["']([^"']+)["']""")


@dataclass(frozen=True)
class Packet:
    """One XMP packet; an empty one has no root."""

    root: Element | None = None

    @classmethod
    def parse(cls, packet: Any) -> "Packet":
        """From bytes or text. A malformed packet is an empty one: cameras do write them, and the images are good."""
        text = packet.decode("utf-8", "replace") if isinstance(packet, bytes) else packet
        if not isinstance(text, str):
            return cls()
        start, end = text.find("<x:xmpmeta"), text.rfind("</x:xmpmeta>")
        if start < 0 or end < 0:
            return cls()
        text = text[start : end + len("</x:xmpmeta>")]
        try:
            root = fromstring(text)
        except (ParseError, DefusedXmlException, ValueError):
            return cls()
        for prefix, uri in _PREFIX.findall(text):
            if not re.fullmatch(r"ns\d+", prefix):
                ElementTree.register_namespace(prefix, uri)  # so that it is written under the name it came with
        return cls(root)

    def values(self) -> dict[tuple[str, str], tuple[str, ...]]:
        """{(namespace, name): values} from all rdf:Description blocks; the first of two counts."""
        found: dict[tuple[str, str], tuple[str, ...]] = {}
        for description in self._descriptions():
            attributes = [(tag, (value,)) for tag, value in description.attrib.items()]
            for tag, raw in [*attributes, *((child.tag, _texts(child)) for child in description)]:
                name, cleaned = _name(tag), tuple(v.strip() for v in raw)
                if name and any(cleaned):
                    found.setdefault(name, cleaned)
        return found

    def remove(self, names: Collection[Name]) -> None:
        """Take values out."""
        for description in self._descriptions():
            for tag in [t for t in description.attrib if _name(t) in names]:
                del description.attrib[tag]
            for child in [c for c in description if _name(c.tag) in names]:
                description.remove(child)

    def take(self, other: "Packet", names: Collection[Name]) -> None:
        """Have another packet's values of these names, or none where it has none."""
        self.remove(names)
        mine = next(self._descriptions(), None)
        if mine is None:
            return
        for description in other._descriptions():
            mine.attrib.update({t: v for t, v in description.attrib.items() if _name(t) in names})
            mine.extend(deepcopy(child) for child in description if _name(child.tag) in names)

    def put(self, name: Name, values: Sequence[str]) -> None:
        """Change a value that is there, in the form in which it is there."""
        for description in self._descriptions():
            for tag in [t for t in description.attrib if _name(t) == name]:
                description.attrib[tag] = ",".join(values)
            for child in [c for c in description if _name(c.tag) == name]:
                items = list(child.iter(f"{_RDF}li"))
                if not items:
                    child.text = ",".join(values)
                elif len(items) == len(values):
                    for item, value in zip(items, values, strict=True):
                        item.text = value
                else:
                    items[0].text = ",".join(values)

    def add(self, name: Name, value: str) -> None:
        """Give it a value that it does not have."""
        self.remove([name])
        mine = next(self._descriptions(), None)
        if mine is not None:
            uri = next(uri for uri, namespace in _NAMESPACES.items() if namespace == name[0])
            ElementTree.SubElement(mine, f"{{{uri}}}{name[1]}").text = value

    def serialised(self) -> bytes:
        """As it stands in a file; nothing for an empty packet."""
        if self.root is None:
            return b""
        body = ElementTree.tostring(self.root, encoding="unicode")
        head, tail = '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>', '<?xpacket end="w"?>'
        return f"{head}\n{body}\n{tail}".encode()

    def _descriptions(self) -> Iterator[Element]:
        return iter(()) if self.root is None else self.root.iter(f"{_RDF}Description")


def _texts(element: Element) -> tuple[str, ...]:
    items = [item.text or "" for item in element.iter(f"{_RDF}li")]
    return tuple(items) if items else (element.text or "",)


def _name(tag: str) -> Name | None:
    uri, _, name = tag.removeprefix("{").rpartition("}")
    namespace: Namespace | None = "Sentera" if "sentera" in uri.lower() else _NAMESPACES.get(uri.rstrip("/"))
    return (namespace, name) if namespace else None
