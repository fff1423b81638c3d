"""What is computed of a shape once, and for another shape anew."""

import trimesh

from dexgrasp import link_shape
from dexgrasp.ball_tree import inscribed_tree
from dexgrasp.hand_body import TIP_TOLERANCE, hand_body
from dexgrasp.link_shape import once_per_shape
from dexgrasp.plugins import load_hand


def test_alike_parts_are_computed_once_and_others_anew(monkeypatch):
    calls = []

    @once_per_shape
    def volume(parts, factor=1.0):
        calls.append(factor)
        return factor * sum(part.volume for part in parts)

    box, ball = trimesh.creation.box((1, 2, 3)), trimesh.creation.icosphere()
    assert volume([box]) == volume([box.copy()]) and len(calls) == 1
    assert volume([box], 2.0) == 2 * volume([box]) and volume([box], factor=3.0) == 3 * volume([box])
    assert volume([box, ball]) > volume([box]) and len(calls) == 4
    box.apply_scale(2)
    assert volume([box]) == 8 * volume([trimesh.creation.box((1, 2, 3))]) and len(calls) == 5
    monkeypatch.setattr(link_shape, "KEPT", 1)
    volume([ball])
    volume([box, ball])  # the first of all had to go
    assert len(calls) == 7


def test_a_second_hand_shares_what_the_first_one_cost():
    hands = load_hand("barrett"), load_hand("barrett")
    trees = [inscribed_tree(hand.collisions[hand.fingers[0].link], TIP_TOLERANCE) for hand in hands]
    assert trees[0] is trees[1]
    first, second = map(hand_body, hands)
    assert first is not second and all((a == b).all() for a, b in zip(first[:-3], second[:-3], strict=True))
