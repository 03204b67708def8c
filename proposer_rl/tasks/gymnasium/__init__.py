"""Any Gymnasium environment as a task, in which settings make a level."""

import sys
from types import ModuleType
from typing import Any, NoReturn


class _Package(ModuleType):
    """Explains what to call instead of this package, which is named as a file of ``conf/task``."""

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError(
            "prl.tasks.gymnasium is a module; call prl.tasks.from_gymnasium(env_id, ...)"
        )


sys.modules[__name__].__class__ = _Package
