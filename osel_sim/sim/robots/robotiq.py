"""Robotiq's 85 mm gripper, which several arms carry. Its fingers are linkages, so what is between its pads is measured.

robosuite's model of it leaves the links loose, on springs, and lets them push one another: they tremble, and now and then fly off. Here the passive
joints follow the driven one as in Robotiq's own description of it, so that the pads stay parallel, and links of one finger do not collide.
"""

from typing import Any
from xml.etree.ElementTree import Element

from osel_sim.interface.robot import Gripper

PREFIX = "gripper0_right_"
DRIVEN = {"left": "finger_joint", "right": "right_outer_knuckle_joint"}
FOLLOWERS = {"inner_finger_joint": -1, "inner_knuckle_joint": 1}
"""Passive joint -> by how much it turns for each radian of the driven one."""
ARMATURE, DAMPING = 0.005, 0.1
"""Of each joint, kg m^2 and N m s; robosuite has none, and its stiff drives then swing on for ever."""


FRICTION = "2 0.05 0.0001"
"""Of the pads: what robosuite gives the Panda's, its own rubber; with the usual friction round things roll out."""


def _finger(side: str) -> tuple[str, ...]:
    return tuple(f"{PREFIX}{side}_{part}_collision" for part in ("outer_finger", "inner_finger", "fingertip", "fingerpad"))


def tighten(model: Any) -> None:
    """Tie the links of robosuite's model to one another."""
    for tendon in list(model.tendon):
        model.tendon.remove(tendon)
    for joint in model.worldbody.iter("joint"):
        joint.set("armature", str(ARMATURE))
        joint.set("damping", str(DAMPING))
    for geom in model.worldbody.iter("geom"):
        if geom.get("name", "").endswith(("fingertip_collision", "fingerpad_collision")):
            geom.set("friction", FRICTION)
    for side, driven in DRIVEN.items():
        for follower, ratio in FOLLOWERS.items():
            model.equality.append(Element("joint", joint1=f"{PREFIX}{side}_{follower}", joint2=PREFIX + driven, polycoef=f"0 {ratio} 0 0 0"))
        for other in ("outer_knuckle", "inner_finger"):
            model.contact.append(Element("exclude", body1=f"{PREFIX}{side}_inner_knuckle", body2=f"{PREFIX}{side}_{other}"))


ROBOTIQ_85 = Gripper(
    model="robosuite.models.grippers:Robotiq85Gripper",
    rest=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    closing=(1.0, 1.0),
    left=_finger("left"),
    right=_finger("right"),
    pads=(f"{PREFIX}left_fingerpad_collision", f"{PREFIX}right_fingerpad_collision"),
    tip=0.01,
    prepare=tighten,
)
