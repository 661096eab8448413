"""Words, numbers and hands at random, for what is painted on the way."""

from __future__ import annotations

import numpy as np

from v2hdm.simulate.render.letters import LETTERS, Hand

WORDS = (
    "STOP", "SLOW", "BUS", "LANE BUS", "TAXI", "SCHOOL", "CLEAR KEEP", "EXIT", "ENTRY NO", "LKW", "HALT",
    "30", "40", "50", "60", "70", "80", "100", "P", "R2", "A14", "B3", "ONLY", "ONLY BUS", "AHEAD STOP",
    "YIELD", "PED XING", "ZONE", "BIKE", "TRAM", "FIRE", "GATE", "QUAI", "EBH", "YARD", "VAN", "MAX 20",
)  # fmt: skip
"""Words one behind the other are read from near to far."""

CAPITALS = tuple(letter for letter in LETTERS if letter != "-")


def random_hand(rng: np.random.Generator) -> Hand:
    """Angular or round, upright or leaning, of even strokes or drawn out along the way, perhaps a stencil."""
    return Hand(
        rounds=int(rng.choice(3, p=[0.4, 0.45, 0.15])),
        stretch=float(rng.uniform(1.5, 3.5) if rng.random() < 0.5 else 1.0),
        slant=float(rng.uniform(-0.1, 0.35) if rng.random() < 0.2 else 0.0),
        stencil=bool(rng.random() < 0.15),
    )


def random_text(rng: np.random.Generator) -> str:
    """A word of the list, a number, a number with letters, or letters by chance."""
    kind = int(rng.choice(4, p=[0.4, 0.3, 0.2, 0.1]))
    number = str(int(np.exp(rng.uniform(0, np.log(3000)))))
    letters = "".join(str(letter) for letter in rng.choice(CAPITALS, int(rng.integers(1, 6))))
    return (str(rng.choice(WORDS)), number, letters[:2] + str(rng.choice(["", "-"])) + number, letters)[kind]
