"""Types and tensor shapes checked as the code runs; for tests, never in a run.

jaxtyping.install_import_hook(["dexgrasp.geometry", ...], "dexgrasp.testing.shapes.check")
"""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a fine float
