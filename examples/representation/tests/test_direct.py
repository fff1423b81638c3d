from dexgrasp.testing import conforms


@conforms("direct")
def test(representation, check):
    check(representation)
