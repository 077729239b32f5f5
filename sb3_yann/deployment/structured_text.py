"""A controller as IEC 61131-3 Structured Text: a function block, and the same in PLCopen XML."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.resources import files
from itertools import groupby
from xml.sax.saxutils import escape

import numpy as np

from sb3_yann.deployment.c_text import shortest as real
from sb3_yann.deployment.describe import Arrays, in_words
from sb3_yann.deployment.rounding import rounding_of
from sb3_yann.deployment.tables import tables_of

ACTIVATE = {
    "tanh": """k := 0;
WHILE k <= 1 DO
    small := MIN(ABS(pair[k]), 25.0);
    small := 1.0 - 2.0 / (EXP(2.0 * small) + 1.0);
    IF pair[k] < 0.0 THEN
        small := -small;
    END_IF;
    IF pair[k] = pair[k] THEN
        pair[k] := small;
    END_IF;
    k := k + 1;
END_WHILE;""",
    "relu": "pair[0] := MAX(pair[0], 0.0);\npair[1] := MAX(pair[1], 0.0);",
    "elu": """k := 0;
WHILE k <= 1 DO
    IF pair[k] < 0.0 THEN
        pair[k] := EXP(pair[k]) - 1.0;
    END_IF;
    k := k + 1;
END_WHILE;""",
}
"""Of both entries of ``pair``; what is no number stays it."""
TYPES = {"double": "LREAL", "float": "REAL"}
RESERVED = set(
    """
    ABS ACTION AND ARRAY AT BOOL BY BYTE CASE CONSTANT COS DATE DINT DO DT DWORD ELSE ELSIF EN
    ENO EXIT EXP FALSE FOR FUNCTION IF INT LEFT LEN LIMIT LINT LN LOG LREAL MAX MID MIN MOD MUX
    NOT OF OR PROGRAM REAL REPEAT RETURN RIGHT SEL SIN SINT STEP STRING STRUCT TAN TASK THEN
    TIME TO TOD TRUE TYPE UDINT UINT ULINT UNTIL USINT VAR WHILE WITH WORD WSTRING XOR
    """.split()
)
"""Words of the language that a function block cannot be called."""
LARGEST, SMALLEST = 1e37, 1e-37
"""Beyond the first a reading counts as infinite, for no standard function asks whether it is.

Below the second a table holds zero. Both are for LREAL too: MatIEC, the compiler of OpenPLC and
Beremiz, reads its literals as REAL first. It also leaves out a FOR loop of one turn, so all loops
are WHILE.
"""


def st_text(data: Arrays, precision: str, about: str) -> str:
    """Return a FUNCTION_BLOCK with the step of a controller.

    Parameters
    ----------
    data : dict of str to ndarray
        As `describe` returns them.
    precision : {"double", "float"}
        LREAL or REAL.
    about : str
        What stands at the top.
    """
    interface, constants, variables, body = _parts(data, precision)
    top = "\n".join(f"  {line}".rstrip() for line in _about(data, about))
    return (
        f"(*\n{top}\n*)\nFUNCTION_BLOCK {data['name']}\n{interface}"
        f"VAR CONSTANT\n{_lines(constants)}END_VAR\nVAR\n{_lines(variables)}END_VAR\n\n"
        f"{body}END_FUNCTION_BLOCK\n"
    )


def plcopen_xml(data: Arrays, precision: str, about: str) -> str:
    """Return the function block in the XML of PLCopen's TC6, version 2.01.

    Parameters are those of :func:`st_text`.
    """
    interface, constants, variables, body = _parts(data, precision)
    kinds = {"VAR_INPUT": "inputVars", "VAR_OUTPUT": "outputVars"}
    found = []
    for kind, tag in kinds.items():
        inner = interface.split(f"{kind}\n", 1)[1].split("END_VAR", 1)[0]
        declared = [line.strip() for line in inner.splitlines()]
        found.append(f"<{tag}>{''.join(map(_variable, declared))}</{tag}>")
    found.append(f"<localVars>{''.join(map(_variable, variables))}</localVars>")
    fixed = "".join(map(_variable, constants))
    found.append(f'<localVars constant="true">{fixed}</localVars>')
    said = escape(". ".join(line for line in _about(data, about) if line))
    stamp = "2000-01-01T00:00:00"  # the same controller is the same file
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n'
        '<project xmlns="http://www.plcopen.org/xml/tc6_0201" '
        'xmlns:xhtml="http://www.w3.org/1999/xhtml">\n'
        f'<fileHeader companyName="" productName="sb3-yann" productVersion="1" '
        f'creationDateTime="{stamp}" contentDescription="{said.replace(chr(34), "&quot;")}"/>\n'
        f'<contentHeader name="{data["name"]}"><coordinateInfo>'
        '<fbd><scaling x="1" y="1"/></fbd><ld><scaling x="1" y="1"/></ld>'
        '<sfc><scaling x="1" y="1"/></sfc></coordinateInfo></contentHeader>\n'
        f'<types><dataTypes/><pous><pou name="{data["name"]}" pouType="functionBlock">\n'
        f"<interface>{''.join(found)}</interface>\n"
        f"<body><ST><xhtml:p>{escape(body)}</xhtml:p></ST></body>\n"
        "</pou></pous></types><instances><configurations/></instances></project>\n"
    )


def _parts(data: Arrays, precision: str) -> tuple[str, list[str], list[str], str]:
    """Return the interface, declarations of constants and of variables, and the body."""
    template = files("sb3_yann.deployment") / "st"
    interface = (template / "interface.st").read_text(encoding="ascii")
    body = (template / "body.st").read_text(encoding="ascii")
    variables = (template / "variables.st").read_text(encoding="ascii")
    sizes, flags = _sizes(data), _flags(data)
    body = _chosen(body, flags)
    variables = _chosen(variables, flags)
    words = {"REAL_TYPE": TYPES[precision], **{k: str(v) for k, v in sizes.items()}}
    words["HIDDEN"] = "h2" if "second" in flags else "h1"
    body = _activated(body, ACTIVATE[str(data["activation"])])
    for key, value in words.items():
        interface, body, variables = (
            text.replace(f"@{key}@", value) for text in (interface, body, variables)
        )
    constants = [*_numbers(data, precision), *_tables(data, precision)]
    declared = [line.strip() for line in variables.splitlines() if line.strip()]
    return interface, constants, declared, body


def _flags(data: Arrays) -> set[str]:
    """Return which parts the body has."""
    found = {str(data["activation"])} if len(data["pinned"]) else set()
    found |= {"networks"} if len(data["pinned"]) else set()
    found |= {"second"} if int(data["n_layers"]) > 2 else {"first only"}
    found |= {"reach"} if np.isfinite(data["reach"]) else set()
    found |= {"rate"} if len(data["change"]) else set()
    return found | ({"zero input"} if data["zero_input"] else set())


def _chosen(text: str, flags: set[str]) -> str:
    """Return a template without the parts, from ``(*? flag *)`` to ``(*.*)``, of other flags."""
    kept: list[str] = []
    open_parts: list[bool] = []
    for line in text.splitlines():
        mark = line.strip()
        if mark.startswith("(*?"):
            open_parts.append(mark[3:-2].strip() in flags)
        elif mark == "(*.*)":
            open_parts.pop()
        elif all(open_parts):
            kept.append(line)
    return "\n".join(kept) + "\n"


def _activated(body: str, lines: str) -> str:
    """Return a body with the activation in its places, indented as they are."""
    found = []
    for line in body.splitlines():
        indent = line[: len(line) - len(line.lstrip())]
        own = line.strip() == "@ACTIVATE@"
        found += [f"{indent}{each}" for each in lines.splitlines()] if own else [line]
    return "\n".join(found) + "\n"


def _sizes(data: Arrays) -> dict[str, int]:
    (p, m, n), hidden = data["gains"].shape, [1, 1]
    for i in range(int(data["n_layers"]) - 1):
        hidden[i] = data[f"layer{i}"].shape[1]
    last = max(int(data["n_layers"]) - 2, 0)
    sizes = {"OBS": data["obs_matrix"].shape[1], "M": m, "N": n, "P": p}
    sizes |= {"H1": hidden[0], "H2": hidden[1], "HL": hidden[last]}
    sizes |= {f"{name}_LAST": size - 1 for name, size in sizes.items()}
    return sizes


def _numbers(data: Arrays, precision: str) -> Iterator[str]:
    """Yield declarations of single numbers."""
    rounding, kind = rounding_of(data, precision), TYPES[precision]
    full, none = data["fades"]
    reals = {
        "TOLERANCE": rounding.tolerance,
        "TIE": rounding.tie,
        "BEYOND_ALL": LARGEST,
        "REACH": min(float(data["reach"]), LARGEST),
        "FADES_FROM": full,
        "FADES_TO": none,
        "LATE_AFTER": min(float(data["late_after"]), LARGEST),
    }
    for name, value in reals.items():
        yield f"{name} : {kind} := {real(value, precision)};"
    for name in ("frozen_after", "hold", "recover", "transfer"):
        yield f"{name.upper()} : DINT := {int(data[name])};"


def _tables(data: Arrays, precision: str) -> Iterator[str]:
    """Yield declarations of arrays, flat: their rows follow each other."""
    numbers, whole = tables_of(data, precision)
    for name, values in numbers.items():
        kept = np.where(np.abs(values) < SMALLEST, 0.0, np.clip(values, -LARGEST, LARGEST))
        texts = [real(float(each), precision) for each in kept.flat]
        yield _array(name, TYPES[precision], texts)
    for name, indices in whole.items():
        yield _array(name, "DINT", [str(int(each)) for each in indices.flat])


def _array(name: str, kind: str, texts: list[str]) -> str:
    """Return the declaration of an array; what repeats is written once, ``3(0.0)``."""
    runs = ((text, len(list(group))) for text, group in groupby(texts))
    entries = [text if count == 1 else f"{count}({text})" for text, count in runs]
    lines, line = [], ""
    for entry in entries:
        if line and len(line) + len(entry) > 90:
            lines.append(line)
            line = ""
        line += f"{', ' if line else ''}{entry}"
    body = ",\n        ".join([*lines, line])
    return f"{name} : ARRAY[0..{len(texts) - 1}] OF {kind} := [{body}];"


def _variable(declared: str) -> str:
    """Return a declaration, ``name : type := value;``, as PLCopen has it."""
    plain = declared.split("(*")[0].strip().rstrip(";")
    name, _, rest = plain.partition(" : ")
    kind, _, value = rest.partition(" := ")
    if kind.startswith("ARRAY"):
        bounds, _, base = kind.partition("] OF ")
        low, _, high = bounds[len("ARRAY[") :].partition("..")
        shown = f'<array><dimension lower="{low}" upper="{high}"/><baseType><{base}/></baseType>'
        shown += "</array>"
        entries = "".join(map(_array_value, value.strip("[]").split(","))) if value else ""
        initial = f"<arrayValue>{entries}</arrayValue>"
    else:
        shown, initial = f"<{kind}/>", f'<simpleValue value="{value}"/>'
    given = f"<initialValue>{initial}</initialValue>" if value else ""
    return f'<variable name="{name}"><type>{shown}</type>{given}</variable>'


def _array_value(entry: str) -> str:
    count, _, inner = entry.strip().rpartition("(")
    repeated = f' repetitionValue="{count}"' if count else ""
    return f'<value{repeated}><simpleValue value="{inner.rstrip(")")}"/></value>'


def _lines(declared: list[str]) -> str:
    return "".join(f"    {line}\n" for line in declared)


def _about(data: Arrays, about: str) -> list[str]:
    """Return the lines of the comment, in ASCII, which nothing in them can end."""
    plain = (
        "\n".join([about, *in_words(data, "command")]).encode("ascii", "backslashreplace").decode()
    )
    return plain.replace("*)", "* )").replace("(*", "( *").splitlines()
