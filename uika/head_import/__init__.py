"""Make other people's head models usable here: read them, embed landmarks, mark regions, write our head file."""

from uika.head_import.from_flame import adopt, import_flame

__all__ = ["adopt", "import_flame"]
