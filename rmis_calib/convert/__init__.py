"""What people have - bags, recorder sessions, data sets, pictures with a table - as a recording folder.

A source module reads one kind of source into `material.Material`, writing pictures as it goes; `assemble` makes the
recording of it. Everything that was guessed is a note, which is printed and kept in recording.yaml.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
