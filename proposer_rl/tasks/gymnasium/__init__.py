"""Any Gymnasium environment as a task: what is set in it makes a level."""

import sys
from types import ModuleType
from typing import Any, NoReturn


class _Package(ModuleType):
    """This package, which has the name of a task's file, as ``prl.tasks.maze`` has that of one."""

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError(
            "gymnasium is a module to import; see prl.tasks.from_gymnasium(env_id, ...)"
        )


sys.modules[__name__].__class__ = _Package
