from dexgrasp.testing import conforms


@conforms("nearby")
def test(backbone, check):
    check(backbone)
