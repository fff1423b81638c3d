from dexgrasp.testing import conforms


@conforms("claw")
def test(hand, check):
    check(hand)
