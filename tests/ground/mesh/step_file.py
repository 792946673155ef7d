"""A STEP file (AP203) of a box, written entity by entity."""

from __future__ import annotations

from itertools import count

import numpy as np

HEADER = """ISO-10303-21;
HEADER;
FILE_DESCRIPTION((''),'2;1');
FILE_NAME('box','2020-01-01T00:00:00',(''),(''),'','','');
FILE_SCHEMA(('CONFIG_CONTROL_DESIGN'));
ENDSEC;
DATA;
"""
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
FACES = [  # corners round each face, seen from outside
    (0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3),
]  # fmt: skip


def step_box(size_mm: tuple[float, float, float]) -> str:
    """The text of a file with one box from the origin, millimetres."""
    lines: list[str] = []
    number = count(1)

    def add(text: str) -> str:
        name = f"#{next(number)}"
        lines.append(f"{name}={text};")
        return name

    def numbers(values: np.ndarray) -> str:
        return "(" + ",".join(f"{float(v):.6f}" for v in values) + ")"

    def point(place: np.ndarray) -> str:
        return add(f"CARTESIAN_POINT('',{numbers(place)})")

    def direction(vector: np.ndarray) -> str:
        return add(f"DIRECTION('',{numbers(vector / np.linalg.norm(vector))})")

    def axes(place: np.ndarray, z: np.ndarray, x: np.ndarray) -> str:
        return add(f"AXIS2_PLACEMENT_3D('',{point(place)},{direction(z)},{direction(x)})")

    places = CORNERS * size_mm
    vertices = [add(f"VERTEX_POINT('',{point(p)})") for p in places]
    edges: dict[tuple[int, int], str] = {}
    for face in FACES:
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            low, high = min(a, b), max(a, b)
            if (low, high) not in edges:
                along = places[high] - places[low]
                vector = add(f"VECTOR('',{direction(along)},{np.linalg.norm(along):.6f})")
                line = add(f"LINE('',{point(places[low])},{vector})")
                edges[low, high] = add(
                    f"EDGE_CURVE('',{vertices[low]},{vertices[high]},{line},.T.)"
                )
    faces = []
    for face in FACES:
        turned = [
            add(f"ORIENTED_EDGE('',*,*,{edges[min(a, b), max(a, b)]},{'.T.' if a < b else '.F.'})")
            for a, b in zip(face, face[1:] + face[:1], strict=True)
        ]
        loop = add(f"EDGE_LOOP('',({','.join(turned)}))")
        bound = add(f"FACE_OUTER_BOUND('',{loop},.T.)")
        a, b, c = (places[k] for k in face[:3])
        plane = add(f"PLANE('',{axes(a, np.cross(b - a, c - b), b - a)})")
        faces.append(add(f"ADVANCED_FACE('',({bound}),{plane},.T.)"))
    shell = add(f"CLOSED_SHELL('',({','.join(faces)}))")
    solid = add(f"MANIFOLD_SOLID_BREP('box',{shell})")
    length = add("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))")
    angle = add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
    cone = add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
    error = add(f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-7),{length},'','')")
    context = add(
        "(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT"
        f"(({error}))GLOBAL_UNIT_ASSIGNED_CONTEXT(({length},{angle},{cone}))"
        "REPRESENTATION_CONTEXT('',''))"
    )
    origin = axes(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    shape = add(f"ADVANCED_BREP_SHAPE_REPRESENTATION('',({origin},{solid}),{context})")
    application = add("APPLICATION_CONTEXT('configuration controlled 3d designs')")
    product_context = add(f"MECHANICAL_CONTEXT('',{application},'mechanical')")
    product = add(f"PRODUCT('box','box','',({product_context}))")
    formation = add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
    design = add(f"DESIGN_CONTEXT('',{application},'design')")
    definition = add(f"PRODUCT_DEFINITION('','',{formation},{design})")
    defined = add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")
    add(f"SHAPE_DEFINITION_REPRESENTATION({defined},{shape})")
    return HEADER + "\n".join(lines) + "\nENDSEC;\nEND-ISO-10303-21;\n"
