"""XMP packets: reading and changing values by namespace, in any of the forms that cameras write."""

import re
from bisect import bisect_left
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

from lxml import etree

from agalign.host.text import without_controls

Name = tuple[str, str]
"""(namespace, name). A namespace is its URI without scheme, `www.`, version and final slash, which differ between
versions of firmware: `micasense.com/DLS`, or only the start of its path, `micasense.com`.
"""


def names_in(namespace: str, names: str) -> tuple[Name, ...]:
    """Return names, separated by spaces, in a namespace."""
    return tuple((namespace, name) for name in names.split())


_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_MAX_PARTS = 50
"""Limit of the parts of a namespace; cameras write three."""
_USUAL = (
    f'xmlns:x="adobe:ns:meta/" xmlns:rdf="{_RDF[1:-1]}" xmlns:Camera="http://pix4d.com/camera/1.0/" '
    'xmlns:MicaSense="http://micasense.com/MicaSense/1.0/" xmlns:DLS="http://micasense.com/DLS/1.0/" '
    'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" xmlns:Sentera="https://www.sentera.com/schemas/" '
    'xmlns:crs="http://ns.adobe.com/camera-raw-settings/1.0/"'
)
"""The prefixes that cameras write, for packets that do not declare them, or wrongly."""
_PREFIXES = dict(re.findall(r'xmlns:([\w-]+)="([^"]+)"', _USUAL))
_USUAL_PREFIX = "|".join(_PREFIXES)
_SAFE = {"resolve_entities": False, "no_network": True, "remove_comments": True, "remove_pis": True}
_STRICT, _RECOVERING = etree.XMLParser(**_SAFE), etree.XMLParser(**_SAFE, recover=True)
_ENVELOPE = r"(?:\w+:)?(?:xmpmeta|xapmeta|RDF)\b"


@dataclass(frozen=True)
class Packet:
    """One XMP packet; an empty one has no root."""

    root: Any = None
    """Element of lxml."""
    unread: tuple[str, ...] | None = None
    """Names of the values in a damaged packet that could not be read; None for an intact packet."""

    @classmethod
    def parse(cls, packet: Any) -> "Packet":
        """Parse bytes or text. Of a damaged packet, what can be read is read."""
        text = packet.decode("utf-8", "replace") if isinstance(packet, bytes) else str(packet)
        max_length = 1 << 19  # cameras write a few thousand characters; the time of repairs is quadratic
        text = text[:max_length].strip("\0 \n")
        start = re.search(f"<({_ENVELOPE})", text)
        if start is None:
            return _recovered(text) if text else cls()
        end_tag = f"</{start[1]}>"
        # Without what is before the first element: no document type, thus no entities.
        whole = text[start.start() : text.rfind(end_tag) + len(end_tag)]
        try:
            root = etree.fromstring(whole, _STRICT)
        except (etree.XMLSyntaxError, ValueError):
            return _recovered(text[start.start() :])
        declared = re.findall(r"""xmlns:([A-Za-z_][\w.-]*)\s*=\s*["']([^"']+)["']""", whole)
        return cls(root) if all(_is_usual(*one) for one in declared) else _recovered(whole)

    def values(self) -> dict[Name, tuple[str, ...]]:
        """Return {(namespace, name): values} of all rdf:Description elements; the first of two values is used.

        A value has a key for its namespace and one for each start of its path. References to entities, which are not
        resolved, are no values.
        """
        result: dict[Name, tuple[str, ...]] = {}
        for description in self._descriptions():
            attributes = [(tag, (value,)) for tag, value in description.attrib.items()]
            for tag, raw in [*attributes, *((child.tag, _texts(child)) for child in description)]:
                cleaned = tuple(
                    "" if v[:1] == "&" and re.fullmatch(r"&\w+;", v) else without_controls(v).strip() for v in raw
                )
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
        for description in self._descriptions():
            for tag in [*description.attrib, *(child.tag for child in description)]:
                uri, _, _ = tag.removeprefix("{").rpartition("}")
                if name[0] in _namespaces(uri):
                    self.remove([name])
                    etree.SubElement(description, f"{{{uri}}}{name[1]}").text = value
                    return

    def serialised(self) -> bytes:
        """Return the bytes of the packet for a file; empty for an empty packet."""
        if self.root is None:
            return b""
        # Declared at the root: moved values keep the prefix by which other software finds them.
        used = {prefix: uri for element in self.root.iter() for prefix, uri in element.nsmap.items()}
        usual = {prefix: uri for prefix, uri in used.items() if prefix and not re.fullmatch(r"ns\d+", prefix)}
        with suppress(ValueError):  # a malformed namespace
            etree.cleanup_namespaces(self.root, top_nsmap=usual)
        body = etree.tostring(self.root, encoding="unicode")
        head, tail = '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>', '<?xpacket end="w"?>'
        return f"{head}\n{body}\n{tail}".encode()

    def _descriptions(self) -> Iterator[Any]:
        return iter(()) if self.root is None else self.root.iter(f"{_RDF}Description")


def _recovered(text: str) -> Packet:
    """What can be read of a damaged packet, as an intact one with all values in one description.

    The last value of a packet that is cut is left out, because it may be cut as well.
    """
    text = re.sub(r"[\0-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]", "", text)
    is_cut = not re.search(f"</{_ENVELOPE}", text)
    if is_cut:
        # Up to the last whole attribute of a start tag that is cut, else up to the last tag.
        start_tag = re.search(r"""<[\w:-]++(?:\s++[\w:-]++\s*+=\s*+(?:"[^"<]*+"|'[^'<]*+'))*+(?=[^<>]*$)""", text)
        text = f"{text[: start_tag.end()]}>" if start_tag else text[: text.rfind(">") + 1]
    # Superfluous end tags would close the elements around them, and the usual prefixes are declared here.
    misleading = (
        rf"""</(?:{_ENVELOPE}|\w+:Description\b)[^<>]*>|\sxmlns:(?:{_USUAL_PREFIX})\s*=\s*(?:"[^"<>]*"|'[^'<>]*')"""
    )
    plain = re.sub(r"&(?!(?:amp|lt|gt|quot|apos|#\d+|#x[\da-fA-F]+);)", "&amp;", re.sub(misleading, " ", text))
    read = etree.fromstring(f"<packet {_USUAL}>{plain}</packet>", _RECOVERING)
    root = etree.fromstring(f"<x:xmpmeta {_USUAL}><rdf:RDF><rdf:Description/></rdf:RDF></x:xmpmeta>", _STRICT)
    description = root[0][0]
    for element in () if read is None else read.iter():
        for tag, value in [*element.attrib.items(), (element.tag, ",".join(_texts(element)))]:
            if _names(tag) and value.strip(" \t\r\n,"):
                with suppress(ValueError):  # characters that XML does not allow
                    etree.SubElement(description, tag).text = value
    if is_cut and len(description):
        last = f"{description[-1].prefix}:{etree.QName(description[-1]).localname}"
        if text.rfind(f"<{last}") > text.rfind(f"</{last}"):
            description.remove(description[-1])
    known = Packet(root).values()
    found = _values_written(text)
    unread = (name for prefix, name in found if not {*_names(f"{{{_PREFIXES[prefix]}}}{name}")} <= known.keys())
    return Packet(root if len(description) else None, (*(["its end"] if is_cut else ()), *dict.fromkeys(unread)))


def _values_written(text: str) -> Iterator[tuple[str, str]]:
    """Yield (prefix, name) of the elements and attributes in a damaged packet, unless they are empty.

    An element is empty if its start tag ends with "/>" or is followed by an end tag. Each delimiter is examined once: a
    search from each name to the end of its tag would take quadratic time in a packet that has lost its delimiters.
    """
    delimiters = [*(one.start() for one in re.finditer(r"[<>=]", text)), len(text)]
    is_empty = [_ends_without_value(text, at, following) for at, following in pairwise(delimiters)]
    for name in re.finditer(rf"[<\s]({_USUAL_PREFIX}):([\w-]++)", text):
        number = bisect_left(delimiters, name.end())
        is_attribute = text[delimiters[number] : delimiters[number] + 1] == "="
        has_text_between = is_attribute and text[name.end() : delimiters[number]].strip()
        if number == len(is_empty) or has_text_between or not is_empty[number]:
            yield name[1], name[2]


def _ends_without_value(text: str, at: int, following: int) -> bool:
    """Return True if a delimiter, before the one that follows it, ends an attribute or element without a value."""
    between = text[at + 1 : following].strip()
    if text[at] == "=":
        return between[:2] in ('""', "''")
    return text[at] == ">" and (text[at - 1 : at] == "/" or (not between and text.startswith("</", following)))


@lru_cache(maxsize=256)
def _is_usual(prefix: str, uri: str) -> bool:
    """False if a usual prefix has another namespace than in any version of firmware."""
    theirs, ours = _namespaces(uri), _namespaces(_PREFIXES.get(prefix, uri))
    return uri == _PREFIXES.get(prefix, uri) if not ours else bool({*theirs[:1]} & {*ours} | {*ours[:1]} & {*theirs})


def _texts(element: Any) -> tuple[str, ...]:
    items = [item.text or "" for item in element.iterfind(f"*/{_RDF}li")] if len(element) else []
    return tuple(items) if items else (element.text or "",)


def _put_texts(element: Any, values: Sequence[str]) -> None:
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
    if uri.startswith(("http://www.w3.org/", "adobe:ns:meta")):
        return []
    scheme_and_version = r"^https?://(?:www\.)?|(?:/\d+(?:\.\d+)*)?/?$"
    path = re.sub(scheme_and_version, "", uri, flags=re.IGNORECASE)
    parts = path.split("/")[:_MAX_PARTS]
    return ["/".join(parts[:count]) for count in range(len(parts), 0, -1)] if path else []
