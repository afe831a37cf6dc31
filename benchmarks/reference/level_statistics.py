"""Statistics of levels: named samples of numbers, defined equally for the reference's levels and ours.

Levels are plain arrays by the reference's names, level axis first (`levelgen.files.kinetix.state_to_kinetix` converts
ours). Imports nothing of ours, because it also runs in the reference's environment.
"""

import numpy as np

SCENERY = 4
GREEN, BLUE, RED = 1, 2, 3
FLOOR_TOP, SIDE = 0.4, 5.0
NOT_THERE = -1  # value of what a level lacks


def statistics(fields):
    """Return {name: 1-D array of values}; the name's first word says whether values are per level, body, joint, ...."""
    bodies = _bodies(fields)
    return _level(fields, bodies) | _body(bodies) | _joint(fields, bodies) | _thruster(fields, bodies)


def _bodies(fields):
    """Concatenate polygons and circles, level axis first."""
    both = {
        name: np.concatenate([fields[f"polygon/{name}"], fields[f"circle/{name}"]], 1)
        for name in ("active", "position", "rotation", "inverse_mass", "inverse_inertia", "friction", "collision_mode")
    }
    both["role"] = np.concatenate([fields["polygon_shape_roles"], fields["circle_shape_roles"]], 1)
    levels, polygons = fields["polygon/active"].shape
    circles = fields["circle/active"].shape[1]
    both["is_polygon"] = np.broadcast_to(np.arange(polygons + circles) < polygons, (levels, polygons + circles))
    both["movable"] = both["active"] & (np.arange(polygons + circles) >= SCENERY)  # a body of the level, not scenery
    both["fixed"] = both["movable"] & (both["inverse_mass"] == 0)
    half = np.abs(fields["polygon/vertices"]).max(2)
    both["half"] = np.concatenate([half, np.zeros((levels, circles, 2))], 1)
    both["radius"] = np.concatenate([np.zeros((levels, polygons)), fields["circle/radius"]], 1)
    cos, sin = np.cos(both["rotation"]), np.sin(both["rotation"])
    corners = fields["polygon/vertices"]
    c, s = cos[:, :polygons, None], sin[:, :polygons, None]
    x = c * corners[..., 0] - s * corners[..., 1] + both["position"][:, :polygons, None, 0]
    y = s * corners[..., 0] + c * corners[..., 1] + both["position"][:, :polygons, None, 1]
    both["corners"] = np.stack([x, y], -1)
    return both


def _level(fields, b):
    role, there, polygon = b["role"], b["movable"], b["is_polygon"]
    goal = {GREEN: there & (role == GREEN), BLUE: there & (role == BLUE)}
    s = {
        "level floor role": role[:, 0],
        "level polygons": (there & polygon).sum(1),
        "level circles": (there & ~polygon).sum(1),
        "level bodies": there.sum(1),
        "level fixed bodies": b["fixed"].sum(1),
        "level red bodies": (there & (role == RED)).sum(1),
        "level joints": fields["joint/active"].sum(1),
        "level fixed joints": (fields["joint/active"] & fields["joint/is_fixed_joint"]).sum(1),
        "level thrusters": fields["thruster/active"].sum(1),
        "level pairs that may not collide": (~fields["collision_matrix"]).sum((1, 2)),
        "level largest joined group": (~fields["collision_matrix"]).sum(2).max(1),
    }
    for name, number in (("green", GREEN), ("blue", BLUE)):
        chosen = goal[number]
        exists = chosen.any(1)
        s |= {
            f"level {name} bodies": chosen.sum(1),
            f"level {name} place": np.where(exists, chosen.argmax(1), NOT_THERE),
            f"level {name} is polygon": np.where(exists, (chosen & polygon).any(1), NOT_THERE),
            f"level {name} is fixed": np.where(exists, (chosen & b["fixed"]).any(1), NOT_THERE),
            f"level {name} x": (chosen * b["position"][..., 0]).sum(1)[exists],
            f"level {name} y": (chosen * b["position"][..., 1]).sum(1)[exists],
            f"level {name} joints": _joints_of(fields, chosen)[exists],
        }
    both = goal[GREEN].any(1) & goal[BLUE].any(1)
    centre = {n: (goal[n][..., None] * b["position"]).sum(1) for n in goal}
    s["level green-blue distance"] = np.linalg.norm(centre[GREEN] - centre[BLUE], axis=-1)[both]
    return s | _overlaps(b)


def _joints_of(fields, chosen):
    """Count active joints on the chosen bodies."""
    ends = [np.take_along_axis(chosen, fields[f"joint/{end}_index"], 1) for end in "ab"]
    return (fields["joint/active"] & (ends[0] | ends[1])).sum(1)


def _overlaps(b):
    """Count overlapping pairs of movable bodies, and bodies beyond the walls or in the floor."""
    polygons = b["corners"].shape[1]
    there = b["movable"]
    pairs = [(i, j) for i in range(SCENERY, polygons) for j in range(i + 1, polygons)]
    rects = sum(there[:, i] & there[:, j] & _separation(b, i, j) for i, j in pairs) if pairs else 0 * there[:, 0]
    circles = range(polygons, there.shape[1])
    rounds, mixed = np.zeros(len(there), int), np.zeros(len(there), int)
    for i in circles:
        for j in circles:
            if i < j:
                gap = np.linalg.norm(b["position"][:, i] - b["position"][:, j], axis=-1)
                rounds += there[:, i] & there[:, j] & (gap < b["radius"][:, i] + b["radius"][:, j])
        for j in range(SCENERY, polygons):
            mixed += there[:, i] & there[:, j] & (_gap(b, j, b["position"][:, i]) < b["radius"][:, i])
    low, high = b["position"] - b["radius"][..., None], b["position"] + b["radius"][..., None]
    low[:, :polygons], high[:, :polygons] = b["corners"].min(2), b["corners"].max(2)
    return {
        "level overlapping polygons": np.asarray(rects).astype(int),
        "level overlapping circles": rounds,
        "level overlapping circle and polygon": mixed,
        "level bodies in the floor": (there & (low[..., 1] < FLOOR_TOP)).sum(1),
        "level bodies beyond a side": (there & ((low[..., 0] < 0) | (high[..., 0] > SIDE))).sum(1),
        "level bodies beyond the ceiling": (there & (high[..., 1] > SIDE)).sum(1),
    }


def _separation(b, i, j):
    """Whether rectangles i and j overlap, by separating axes."""
    overlap = np.ones(len(b["corners"]), bool)
    for body in (i, j):
        for turn in (0, np.pi / 2):
            angle = b["rotation"][:, body] + turn
            axis = np.stack([np.cos(angle), np.sin(angle)], -1)[:, None]
            one, two = ((b["corners"][:, k] * axis).sum(-1) for k in (i, j))
            overlap &= (one.min(1) < two.max(1)) & (two.min(1) < one.max(1))
    return overlap


def _gap(b, polygon, point):
    """Return the distance of a point from a rectangle, zero inside."""
    local = _turn(point - b["position"][:, polygon], -b["rotation"][:, polygon])
    return np.linalg.norm(np.maximum(np.abs(local) - b["half"][:, polygon], 0), axis=-1)


def _turn(v, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], -1)


def _body(b):
    there, polygon = b["movable"], b["is_polygon"]
    mass = 1 / np.where(b["inverse_mass"] == 0, 1, b["inverse_mass"])
    inertia = 1 / np.where(b["inverse_inertia"] == 0, 1, b["inverse_inertia"])
    s = {"body role": b["role"][there], "body place": np.nonzero(there)[1]}
    for kind, these in (("polygon", there & polygon), ("circle", there & ~polygon)):
        free, fixed = these & ~b["fixed"], these & b["fixed"]
        s |= {
            f"{kind} role": b["role"][these],
            f"{kind} fixed": b["fixed"][these],
            f"{kind} x": b["position"][these][:, 0],
            f"{kind} y": b["position"][these][:, 1],
            f"{kind} rotation": b["rotation"][these],
            f"{kind} mass": mass[free],
            f"{kind} inertia": inertia[free],
            f"{kind} y if fixed": b["position"][fixed][:, 1],
            f"{kind} red, y": b["position"][these & (b["role"] == RED)][:, 1],
            f"{kind} friction": b["friction"][these],
        }
    rect = there & polygon
    s |= {
        "polygon width": 2 * b["half"][rect][:, 0],
        "polygon height": 2 * b["half"][rect][:, 1],
        "polygon longer side over shorter": b["half"][rect].max(-1) / b["half"][rect].min(-1),
        "polygon longer side if fixed": 2 * b["half"][rect & b["fixed"]].max(-1),
        "polygon longer side of green and blue": 2 * b["half"][rect & np.isin(b["role"], (GREEN, BLUE))].max(-1),
        "circle radius": b["radius"][there & ~polygon],
        "circle radius if fixed": b["radius"][there & b["fixed"] & ~polygon],
        "circle radius of green and blue": b["radius"][there & ~polygon & np.isin(b["role"], (GREEN, BLUE))],
    }
    return s


def _joint(fields, b):
    active = fields["joint/active"]
    j = {name: fields[f"joint/{name}"][active] for name in _JOINT}
    ends = {end: {name: _take(b[name], fields[f"joint/{end}_index"])[active] for name in _ENDS} for end in "ab"}
    turns, driven = ~j["is_fixed_joint"], j["motor_on"]
    wheel = ~(ends["a"]["is_polygon"] & ends["b"]["is_polygon"])
    world = [ends[end]["position"] + _turn(j[f"{end}_relative_pos"], ends[end]["rotation"]) for end in "ab"]
    difference = ends["b"]["rotation"] - ends["a"]["rotation"]
    limited = j["motor_has_joint_limits"]
    cover = [_depth(ends[end], j[f"{end}_relative_pos"]) for end in "ab"]
    scale = [np.where(wheel[:, None], 1.0, ends[end]["half"]) for end in "ab"]
    s = {
        "joint place": np.nonzero(active)[1],
        "joint kinds": ends["a"]["is_polygon"] * 2 + ends["b"]["is_polygon"],
        "joint first body is first": j["a_index"] < j["b_index"],
        "joint to scenery": (j["a_index"] < SCENERY) | (j["b_index"] < SCENERY),
        "joint to a fixed body": ends["a"]["fixed"] | ends["b"]["fixed"],
        "joint roles": np.minimum(ends["a"]["role"], ends["b"]["role"]) * 4
        + np.maximum(ends["a"]["role"], ends["b"]["role"]),
        "joint gap": (np.abs(world[0] - world[1]).max(-1) > 1e-4),
        "joint fixed": ~turns,
        "joint rotation error": np.abs(j["rotation"] - np.where(turns, 0, difference)) > 1e-4,
        "joint angle": difference[turns],
        "joint angle if fixed": difference[~turns],
        "joint limited": limited[turns],
        "joint limited wheel": limited[turns & wheel],
        "joint limit min": j["min_rotation"][limited],
        "joint limit max": j["max_rotation"][limited],
        "joint motor on": driven[turns],
        "joint motor of fixed": (j["motor_power"] + j["motor_speed"])[~turns],
        "joint motor speed": j["motor_speed"][turns],
        "joint motor power": j["motor_power"][turns & ~wheel],
        "joint wheel power": j["motor_power"][turns & wheel],
        "joint binding": fields["motor_bindings"][active],
        "joint automatic": fields["motor_auto"][active],
        "joint x": world[0][:, 0],
        "joint y": world[0][:, 1],
        "joint depth in first": cover[0][~wheel],
        "joint depth in second": cover[1][~wheel],
        "joint depth under a wheel": np.where(ends["a"]["is_polygon"], *cover)[wheel],
        "joint wheel radius": np.maximum(ends["a"]["radius"], ends["b"]["radius"])[wheel],
        "joint mass ratio": _ratio(ends["a"]["inverse_mass"], ends["b"]["inverse_mass"]),
    }
    for place, end in enumerate("ab"):
        share = (j[f"{end}_relative_pos"] / np.maximum(scale[place], 1e-9))[~wheel]
        s |= {f"joint anchor {end} x": share[:, 0], f"joint anchor {end} y": share[:, 1]}
    return s


_JOINT = ("a_index", "b_index", "a_relative_pos", "b_relative_pos", "is_fixed_joint", "rotation", "motor_on")
_JOINT += ("motor_speed", "motor_power", "motor_has_joint_limits", "min_rotation", "max_rotation")
_ENDS = ("is_polygon", "fixed", "role", "position", "rotation", "half", "radius", "inverse_mass")


def _take(values, index):
    """Take values (level, body, ...) at body indices (level, joint)."""
    spread = index.reshape(*index.shape, *[1] * (values.ndim - 2))
    return np.take_along_axis(values, np.broadcast_to(spread, (*index.shape, *values.shape[2:])), 1)


def _depth(body, anchor):
    """Return the distance of an anchor from the nearest side of a rectangle."""
    return (body["half"] - np.abs(anchor)).min(-1)


def _ratio(a, b):
    """Return the smaller over the larger of two values, where neither is zero."""
    a, b = (x[(a > 0) & (b > 0)] for x in (a, b))
    return np.minimum(a, b) / np.maximum(a, b)


def _thruster(fields, b):
    active = fields["thruster/active"]
    t = {name: fields[f"thruster/{name}"][active] for name in ("relative_position", "rotation", "power")}
    body = {name: _take(b[name], fields["thruster/object_index"])[active] for name in _ENDS}
    position = t["relative_position"]
    cross = position[:, 0] * np.sin(t["rotation"]) - position[:, 1] * np.cos(t["rotation"])
    inward = position[:, 0] * np.cos(t["rotation"]) + position[:, 1] * np.sin(t["rotation"]) < 0
    aligned = np.abs(cross) <= 1e-5
    polygon = body["is_polygon"]
    share = position[polygon] / np.maximum(body["half"][polygon], 1e-9)
    return {
        "thruster place": np.nonzero(active)[1],
        "thruster on polygon": polygon,
        "thruster on fixed": body["fixed"],
        "thruster body role": body["role"],
        "thruster x in polygon": share[:, 0],
        "thruster y in polygon": share[:, 1],
        "thruster distance in circle": (np.linalg.norm(position, axis=-1) / np.maximum(body["radius"], 1e-9))[~polygon],
        "thruster rotation": np.mod(t["rotation"], 2 * np.pi),
        "thruster aligned": aligned,
        "thruster rotation if not aligned": t["rotation"][~aligned],
        "thruster inward if aligned": inward[aligned],
        "thruster power": t["power"],
        "thruster power per mass": t["power"] * body["inverse_mass"],
        "thruster binding": fields["thruster_bindings"][active],
    }
