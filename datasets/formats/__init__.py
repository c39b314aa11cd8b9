"""Maps in other people's formats: one registry, one file per format. See docs/formats.md for what each one holds."""

from .contents import contents, without
from .reading import Reading
from .registry import Format, format_of, formats, read_all, read_any, write_any

__all__ = ["Format", "Reading", "contents", "format_of", "formats", "read_all", "read_any", "without", "write_any"]
