"""A controller as IEC 61131-3 Structured Text: a function block, and the same in PLCopen XML."""

from __future__ import annotations

import re
import textwrap
from importlib.resources import files
from itertools import groupby
from xml.sax.saxutils import escape

import numpy as np

from sb3_yann.deployment import code
from sb3_yann.deployment.code import ControllerArrays, decimal
from sb3_yann.deployment.controller import DRIVING, KEPT_ROUNDING

RESERVED = re.compile(
    "|".join(
        """
        ABS ABSTRACT ACOS ACTION ADD AND ARRAY ASIN AT ATAN BOOL BY BYTE CASE CHAR CLASS CONCAT
        CONFIGURATION CONSTANT CONTINUE COS CT[DU]+ DATE DATE_AND_TIME DELETE DINT DIV DO DT DWORD
        ELSE ELSIF END_.* EN ENO EQ EXIT EXP EXPT FALSE FIND FOR FROM FUNCTION FUNCTION_BLOCK
        F_EDGE F_TRIG GE GT IF INITIAL_STEP INSERT INT INTERFACE INTERVAL LE LEFT LEN LIMIT LINT LN
        LOG LREAL LDATE LDT LT LTIME LTOD LWORD MAX METHOD MID MIN MOD MOVE MUL MUX NAMESPACE NE
        NOT NULL OF ON OR POINTER PRIORITY PROGRAM READ_ONLY READ_WRITE REAL REF_TO REPEAT REPLACE
        RESOURCE RETAIN RETURN RIGHT RO[LR] RS R_EDGE R_TRIG SEL SEMA SH[LR] SIN SINGLE SINT SQRT
        SR STEP STRING STRUCT SUB TAN TASK THEN TIME TIME_OF_DAY TO TOD TOF TON TP TRANSITION TRUE
        TRUNC TYPE UDINT UINT ULINT UNTIL USINT VAR VAR_.* WCHAR WHILE WITH WORD WSTRING XOR .*__.*
        .*_ (BOOL|BYTE|D?WORD|L?REAL|[USDL]*INT|TIME|DATE|STRING)_TO_.*
        """.split()
    ),
    re.IGNORECASE,
)
"""Words of the language that a function block cannot be called, and what is no name in it."""


def st_text(data: ControllerArrays, precision: str, about: str) -> str:
    """Return a FUNCTION_BLOCK with the step of a controller."""
    interface, constants, variables, body = _parts(data, precision)
    top = "\n".join(f"  {line}".rstrip() for line in _comment(data, about))
    constant, own = ("".join(f"    {line}\n" for line in each) for each in (constants, variables))
    return (
        f"(*\n{top}\n*)\nFUNCTION_BLOCK {data['name']}\n{interface}"
        f"VAR CONSTANT\n{constant}END_VAR\nVAR\n{own}END_VAR\n\n{body}END_FUNCTION_BLOCK\n"
    )


def plcopen_xml(data: ControllerArrays, precision: str, about: str) -> str:
    """Return the function block in the XML of PLCopen's TC6, version 2.01; as :func:`st_text`."""
    interface, constants, variables, body = _parts(data, precision)
    groups = []
    for kind, tag in {"VAR_INPUT": "inputVars", "VAR_OUTPUT": "outputVars"}.items():
        lines = interface.split(f"{kind}\n", 1)[1].split("END_VAR", 1)[0].splitlines()
        groups.append(f"<{tag}>{''.join(_variable(line.strip()) for line in lines)}</{tag}>")
    groups.append(f"<localVars>{''.join(map(_variable, variables))}</localVars>")
    groups.append(f'<localVars constant="true">{"".join(map(_variable, constants))}</localVars>')
    text = escape(". ".join(line for line in _comment(data, about) if line))
    # A fixed time stamp: the same controller is the same file.
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n'
        '<project xmlns="http://www.plcopen.org/xml/tc6_0201" '
        'xmlns:xhtml="http://www.w3.org/1999/xhtml">\n'
        f'<fileHeader companyName="" productName="sb3-yann" productVersion="1" '
        f'creationDateTime="2000-01-01T00:00:00" '
        f'contentDescription="{text.replace(chr(34), "&quot;")}"/>\n'
        f'<contentHeader name="{data["name"]}"><coordinateInfo>'
        '<fbd><scaling x="1" y="1"/></fbd><ld><scaling x="1" y="1"/></ld>'
        '<sfc><scaling x="1" y="1"/></sfc></coordinateInfo></contentHeader>\n'
        f'<types><dataTypes/><pous><pou name="{data["name"]}" pouType="functionBlock">\n'
        f"<interface>{''.join(groups)}</interface>\n"
        f"<body><ST><xhtml:p>{escape(body)}</xhtml:p></ST></body>\n"
        "</pou></pous></types><instances><configurations/></instances></project>\n"
    )


def _parts(data: ControllerArrays, precision: str) -> tuple[str, list[str], list[str], str]:
    """Return the interface, declarations of constants and of variables, and the body."""
    networks = len(data["pinned"]) > 0
    n_layers = int(data["n_layers"])
    flags = {
        str(data["activation"]): networks,
        "networks": networks,
        "second": n_layers > 2,
        "kept": networks and len(data["kept"]) > 0,
        "rate": len(data["change"]) > 0,
        "moving": len(data["moving"]) > 0,
        "zero input": bool(data["zero_input"]),
        "estimator": "est_gain" in data,
        "readings alone": "est_gain" not in data,
        "loads": len(data.get("est_loads", ())) > 0,
    }
    (p, m, n) = data["gains"].shape
    hidden = [1, 1]
    for i in range(n_layers - 1):
        hidden[i] = data[f"layer{i}"].shape[1]
    sizes = {"OBS": len(data["obs_rest"]), "SEEN": data["obs_matrix"].shape[1]}
    sizes |= {"M": m, "N": n, "P": p}
    if flags["estimator"]:
        (size, q) = data["est_gain"].shape
        loads = len(data["est_loads"])
        sizes |= {"EST": size, "Q": q, "LOADS": loads, "FIRST": q + 1}
        sizes |= {"STEP": size + m + loads + 1, "REST": q + m + loads + 1}
        sizes["ROOM"] = size + q + m + loads
    sizes |= {"KEPT": len(data["kept"]), "WIDE": n + m + 2}
    sizes |= {"H1": hidden[0], "H2": hidden[1], "HL": hidden[max(n_layers - 2, 0)]}
    kind = "LREAL" if precision == "double" else "REAL"
    entries = {"REAL_TYPE": kind, "HIDDEN": "h2" if flags["second"] else "h1"}
    entries |= {key: str(size) for key, size in sizes.items()}
    entries |= {f"{key}_LAST": str(size - 1) for key, size in sizes.items()}
    chosen = {flag for flag, is_there in flags.items() if is_there}

    def filled(part: str) -> str:
        text = (files("sb3_yann.deployment") / "st" / f"{part}.st").read_text(encoding="ascii")
        text = _chosen(text, chosen)
        for key, entry in entries.items():
            text = text.replace(f"@{key}@", entry)
        return text

    lines = filled("activation").rstrip()  # of both entries of pair; NaN stays NaN
    body = filled("body")
    body = re.sub(" *@ACTIVATE@", lambda at: textwrap.indent(lines, at[0][:-10]), body)
    used = set(re.findall(r"\w+", body))
    declared = map(str.strip, filled("variables").splitlines())
    constants, own = (
        [line for line in lines if line.partition(" : ")[0] in used]
        for lines in (_constants(data, precision, kind), declared)
    )
    return filled("interface"), constants, own, body


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


def _constants(data: ControllerArrays, precision: str, kind: str) -> list[str]:
    """Return declarations of numbers and tables; these are flat, their rows follow each other."""
    # No standard function asks whether a reading is infinite: beyond 1e37 it counts as such, and
    # entries below 1e-37 are zero. Both are for LREAL too: MatIEC, the compiler of OpenPLC and
    # Beremiz, reads its literals as REAL first. It also leaves out a FOR loop of one turn, so all
    # loops are WHILE.
    max_real = 1e37
    tolerances = code.search_tolerances(data, precision)
    fade_start, fade_end = data["fades"]
    reals = {
        "TOLERANCE": tolerances["tolerance"],
        "TIE": tolerances["tie"],
        "BEYOND_ALL": max_real,
        "REACH": min(float(data["reach"]), max_real),
        "FADES_FROM": fade_start,
        "FADES_TO": fade_end,
        "KEPT_ROUNDING": KEPT_ROUNDING,
        "LATE_AFTER": min(float(data["late_after"]), max_real),
        "DRIVING": DRIVING,
    }
    lines = [f"{name} : {kind} := {decimal(value, precision)};" for name, value in reals.items()]
    for name in ("frozen_after", "hold", "recover", "transfer"):
        lines.append(f"{name.upper()} : DINT := {int(data[name])};")
    numbers, indices = code.controller_tables(data, precision, walk=False)
    for name, values in numbers.items():
        kept = np.where(np.abs(values) < 1e-37, 0.0, np.clip(values, -max_real, max_real))
        lines.append(_array(name, kind, [decimal(each, precision) for each in kept.flat]))
    for name, values in indices.items():
        lines.append(_array(name, "DINT", [str(each) for each in values.flat]))
    return lines


def _array(name: str, kind: str, texts: list[str]) -> str:
    """Return the declaration of an array; what repeats is written once, ``3(0.0)``."""
    runs = ((text, len(list(group))) for text, group in groupby(texts))
    entries = [text if count == 1 else f"{count}({text})" for text, count in runs]
    lines = textwrap.wrap(", ".join(entries), 90, break_on_hyphens=False)
    body = "\n        ".join(lines)
    return f"{name} : ARRAY[0..{len(texts) - 1}] OF {kind} := [{body}];"


def _variable(declared: str) -> str:
    """Return a declaration, ``name : type := value;``, as PLCopen has it."""
    name, _, rest = declared.split("(*")[0].strip().rstrip(";").partition(" : ")
    kind, _, value = rest.partition(" := ")
    shown = f"<{kind}/>"
    initial = f'<simpleValue value="{value}"/>'
    if kind.startswith("ARRAY"):
        bounds, _, base = kind.removeprefix("ARRAY[").partition("] OF ")
        low, _, high = bounds.partition("..")
        shown = f'<array><dimension lower="{low}" upper="{high}"/><baseType><{base}/></baseType>'
        shown += "</array>"
        entries = []
        for entry in value.strip("[]").split(","):
            count, _, inner = entry.strip().rpartition("(")
            repeated = f' repetitionValue="{count}"' if count else ""
            plain = inner.rstrip(")")
            entries.append(f'<value{repeated}><simpleValue value="{plain}"/></value>')
        initial = f"<arrayValue>{''.join(entries)}</arrayValue>"
    given = f"<initialValue>{initial}</initialValue>" if value else ""
    return f'<variable name="{name}"><type>{shown}</type>{given}</variable>'


def _comment(data: ControllerArrays, about: str) -> list[str]:
    """Return the lines of the comment, in ASCII, which nothing in them can end."""
    plain = code.ascii_text([about, *code.signal_lines(data, "command")])
    return plain.replace("*)", "* )").replace("(*", "( *").splitlines()
