"""scipy, loaded when something of it is used.

It loads a seventh of what numpy does before anybody asks for a function, and many commands never
do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__all__ = ['scipy']

if TYPE_CHECKING:
    import scipy
else:

    class _Late:
        def __getattr__(self, name: str) -> Any:
            import scipy

            found = getattr(scipy, name)
            setattr(self, name, found)
            return found

    scipy = _Late()
