"""Physical terms that a model may lack, built from MuJoCo's own elements.

Each kind of term is a record that adds elements to an MjSpec before it is compiled, and that says
which numbers of the compiled model its fields are.
"""

from __future__ import annotations
