"""Masses and inertias: whether a simulator takes them, and whether they are those of such a body."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dexgrasp.doctor.description import Description
from dexgrasp.doctor.finding import Finding, error, warning

TRIANGLE, BAD_TRIANGLE = 1.001, 1.5
"""Largest moment over the sum of the others: above the first it is mended, above the second it is another body's."""
HEAVY, HEAVY_HAND = 5.0, 8.0
"""Masses of a link and of a hand that are strange, kg."""
SPREAD, FAR = 2.5, 5.0
"""Radius of gyration over the link's length: strange, impossible."""


@dataclass(frozen=True)
class Inertial:
    """What the URDF says of one link."""

    mass: float
    centre: np.ndarray
    """(3,) link frame, m."""
    moments: np.ndarray
    """(3,) principal, ascending, about the centre of mass, kg m2."""


def inertias_are_physical(hand: Description) -> Iterator[Finding]:
    """Inertia tensors are those of a body: positive, and no moment larger than the two others together."""
    for link, told in _told(hand).items():
        shown = " ".join(f"{moment:.3g}" for moment in told.moments)
        if not np.isfinite([told.mass, *told.centre, *told.moments]).all():
            yield error(link, "mass or inertia is no number", "no simulator takes it", "correct its <inertial>")
        elif told.moments[0] < 0 or (told.moments[0] == 0 and told.moments[2] > 0):
            yield error(
                link,
                f"its inertia is not positive definite (principal moments {shown} kg m2)",
                "no body has it: MuJoCo refuses the model, others compute motions that explode",
                "compute it from the mesh and the mass (trimesh: mesh.moment_inertia); look for a lost minus sign",
            )
        elif told.moments[2] > TRIANGLE * (told.moments[0] + told.moments[1]):
            ratio = told.moments[2] / (told.moments[0] + told.moments[1])
            tell = error if ratio > BAD_TRIANGLE else warning
            yield tell(
                link,
                f"its inertia breaks the triangle inequality {ratio:.2f}-fold (principal moments {shown} kg m2)",
                "no body has it and MuJoCo refuses it; here the largest moment is cut to the sum of the others",
                "compute it from the mesh and the mass (trimesh: mesh.moment_inertia)",
            )


def moving_links_have_mass(hand: Description) -> Iterator[Finding]:
    """What moves has a mass, and an inertia unless it is a frame."""
    told = _told(hand)
    root = next(iter(hand.bodies))
    for carrier, links in hand.bodies.items():
        masses = [told[link].mass for link in links if link in told]
        total = sum(masses)
        for link in links:
            if link in told and told[link].mass < 0:
                yield error(link, f"mass {told[link].mass:g} kg", "no body has it", "write its mass in kg")
        if total > 0 or any(mass < 0 for mass in masses):
            if total > 0 and not any(link in told and told[link].moments[2] > 0 for link in links):
                yield warning(
                    carrier,
                    f"{total:g} kg without any inertia",
                    "MuJoCo refuses a moving body without inertia; here 1e-7 kg m2 is taken",
                    "compute it from the mesh and the mass (trimesh: mesh.moment_inertia)",
                )
            continue
        solid = any(hand.has_geometry(link) for link in links)
        tell = error if solid and carrier != root else warning
        yield tell(
            carrier,
            "no mass" + (f" (with {', '.join(links[1:])}, fixed to it)" if links[1:] else ""),
            "a simulator refuses a moving body without mass; here 1 g is taken, so lift tests are another hand's",
            "give the link an <inertial> with mass (kg), centre and inertia",
        )


def masses_fit_the_links(hand: Description) -> Iterator[Finding]:
    """Masses, centres and inertias belong to bodies of the links' size: kilograms and metres."""
    told = _told(hand)
    total = sum(inertial.mass for inertial in told.values())
    if total > HEAVY_HAND:
        yield warning(
            hand.name, f"{total:g} kg in all", "hands weigh 0.2 to 5 kg", "write kilograms; leave the arm out by `root`"
        )
    for link, inertial in told.items():
        if inertial.mass > HEAVY:
            yield warning(
                link, f"{inertial.mass:g} kg", "a finger's link weighs some 10 g", "write kilograms, not grams"
            )
        length = hand.extent(link)
        if not length or inertial.mass <= 0 or not np.isfinite(inertial.moments).all():
            continue
        gyration = float(np.sqrt(max(inertial.moments[2], 0) / inertial.mass))
        if gyration > SPREAD * length:
            tell = error if gyration > FAR * length else warning
            yield tell(
                link,
                f"its inertia is that of a body spread over {gyration:.3g} m; the link is {length:.3g} m long",
                "joints would turn as if weighted far outside; servos tuned to it swing or crawl",
                "write kg m2 (1 g mm2 = 1e-9 kg m2), about the centre of mass",
            )
        away = _outside(hand, link, inertial.centre)
        if away > max(length, 0.02):
            yield warning(
                link,
                f"its centre of mass lies {away:.3g} m outside its mesh",
                "the link would swing about a point outside itself",
                "write the centre in link coordinates, m",
            )


def _told(hand: Description) -> dict[str, Inertial]:
    found = {}
    for link, element in hand.links.items():
        tag = element.find("inertial")
        if tag is None:
            continue
        mass, inertia, origin = tag.find("mass"), tag.find("inertia"), tag.find("origin")
        try:
            value = {key: float(inertia.get(key, 0)) if inertia is not None else 0.0 for key in KEYS}
            matrix = np.array([[value[a] for a in row] for row in ROWS])
            centre = [float(word) for word in (origin.get("xyz", "0 0 0") if origin is not None else "0 0 0").split()]
            kilograms = float(mass.get("value", 0)) if mass is not None else 0.0
            moments = np.linalg.eigvalsh(matrix) if np.isfinite(matrix).all() else np.full(3, np.nan)
            # Rounding of a thin body's tensor is no fault.
            moments = np.where(np.abs(moments) < 1e-9 * np.abs(moments).max(), 0.0, moments)
            found[link] = Inertial(kilograms, np.array(centre), moments)
        except (ValueError, np.linalg.LinAlgError):
            found[link] = Inertial(np.nan, np.full(3, np.nan), np.full(3, np.nan))
    return found


KEYS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
ROWS = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))


def _outside(hand: Description, link: str, point: np.ndarray) -> float:
    """Return how far a point lies outside the box about a link's meshes (m); tags with an origin are left out."""
    boxes = []
    for tag in ("visual", "collision"):
        for element in hand.links[link].findall(tag):
            if element.find("origin") is not None:
                return 0.0
        boxes += [f.mesh.bounds for f in hand.meshes if f.link == link and f.tag == tag and f.mesh is not None]
    if not boxes or not np.isfinite(point).all():
        return 0.0
    low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
    return float(np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0)))
