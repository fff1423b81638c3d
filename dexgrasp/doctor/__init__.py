"""The doctor of hands: what is wrong with one, why it matters, how to mend it.

`examine("myhand")` tries the conformance laws and everything that goes wrong in practice. Checks of `ON_FILE` read YAML
and URDF as they stand, so they speak even where the hand cannot be loaded; checks of `ON_HAND` look at the loaded hand.
"""

from dexgrasp.doctor.examination import Examination, examine
from dexgrasp.doctor.finding import Finding, Severity

__all__ = ["Examination", "Finding", "Severity", "examine"]
