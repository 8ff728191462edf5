"""Functions of the FMI standard around the printed C, for each version."""

from __future__ import annotations

import re
from collections.abc import Sequence

_COMMON = r"""/* FMI @VERSION@.0 co-simulation around model.c. */
#include "model.h"
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

#define PAST_U (ASIA_PAST_INPUTS * ASIA_INPUTS)
#define PAST_Y (ASIA_PAST_OUTPUTS * ASIA_OUTPUTS)
#define VALUES (ASIA_INPUTS + ASIA_OUTPUTS + PAST_U + PAST_Y)

enum { OK = 0, ERROR = 3 };

/* References count from 1: inputs, outputs, past inputs, past outputs. */
typedef struct {
    asia_state x;
    asia_real v[VALUES];
    double time;
    int started;
} unit;

static void reset(unit *m)
{
    static const double start[VALUES] = {
        @STARTS@
    };
    int i;
    memset(m, 0, sizeof *m);
    for (i = 0; i < VALUES; ++i)
        m->v[i] = (asia_real)start[i];
}

static int get(const unit *m, const uint32_t *refs, size_t n, double *values)
{
    size_t i;
    for (i = 0; i < n; ++i) {
        if (refs[i] > VALUES)
            return ERROR;
        values[i] = refs[i] == 0 ? m->time : (double)m->v[refs[i] - 1];
    }
    return OK;
}

static int set(unit *m, const uint32_t *refs, size_t n, const double *values)
{
    size_t i;
    for (i = 0; i < n; ++i) {
        if (refs[i] == 0 || refs[i] > VALUES)
            return ERROR;
        m->v[refs[i] - 1] = (asia_real)values[i];
    }
    return OK;
}

static int advance(unit *m, double now, double step)
{
    const asia_real *past = m->v + ASIA_INPUTS + ASIA_OUTPUTS;
    if (!(fabs(step - ASIA_SAMPLING_TIME) <= 1e-6 * ASIA_SAMPLING_TIME))
        return ERROR;
    if (!m->started) {
        asia_init(&m->x, past, past + PAST_U, m->v);
        m->started = 1;
    }
    /* The output of this sample, before the states move. */
    asia_step(&m->x, m->v, m->v + ASIA_INPUTS);
    m->time = now + step;
    return OK;
}

static unit *created(const char *token)
{
    unit *m = NULL;
    if (token == NULL || strcmp(token, "@TOKEN@") == 0)
        m = malloc(sizeof *m);
    if (m != NULL)
        reset(m);
    return m;
}
"""

# Functions as "name(arguments) | body"; m is the unit.
_TWO = """
typedef void *P; typedef const char *S; typedef int I; typedef const uint32_t *R; typedef size_t N;
S fmi2GetTypesPlatform(void) | return "default";
S fmi2GetVersion(void) | return "2.0";
I fmi2SetDebugLogging(P m, I on, N n, const S *c) | return OK;
P fmi2Instantiate(S name, I kind, S token, S place, const P calls, I shown, I on) | return kind == 1 ? created(token) : NULL;
void fmi2FreeInstance(P m) | free(m);
I fmi2SetupExperiment(P m, I d, double tol, double t, I e, double end) | ((unit *)m)->time = t; return OK;
I fmi2EnterInitializationMode(P m) | return OK;
I fmi2ExitInitializationMode(P m) | return OK;
I fmi2Terminate(P m) | return OK;
I fmi2Reset(P m) | reset(m); return OK;
I fmi2GetReal(P m, R r, N n, double *v) | return get(m, r, n, v);
I fmi2SetReal(P m, R r, N n, const double *v) | return set(m, r, n, v);
I fmi2GetInteger(P m, R r, N n, int *v) | return n ? ERROR : OK;
I fmi2GetBoolean(P m, R r, N n, int *v) | return n ? ERROR : OK;
I fmi2GetString(P m, R r, N n, S *v) | return n ? ERROR : OK;
I fmi2SetInteger(P m, R r, N n, const int *v) | return n ? ERROR : OK;
I fmi2SetBoolean(P m, R r, N n, const int *v) | return n ? ERROR : OK;
I fmi2SetString(P m, R r, N n, const S *v) | return n ? ERROR : OK;
I fmi2GetFMUstate(P m, P *s) | return ERROR;
I fmi2SetFMUstate(P m, P s) | return ERROR;
I fmi2FreeFMUstate(P m, P *s) | return ERROR;
I fmi2SerializedFMUstateSize(P m, P s, N *n) | return ERROR;
I fmi2SerializeFMUstate(P m, P s, char *b, N n) | return ERROR;
I fmi2DeSerializeFMUstate(P m, const char *b, N n, P *s) | return ERROR;
I fmi2GetDirectionalDerivative(P m, R a, N n, R b, N k, const double *d, double *v) | return ERROR;
I fmi2SetRealInputDerivatives(P m, R r, N n, const int *o, const double *v) | return ERROR;
I fmi2GetRealOutputDerivatives(P m, R r, N n, const int *o, double *v) | return ERROR;
I fmi2DoStep(P m, double t, double h, I d) | return advance(m, t, h);
I fmi2CancelStep(P m) | return ERROR;
I fmi2GetStatus(P m, I k, I *v) | return ERROR;
I fmi2GetRealStatus(P m, I k, double *v) | return ERROR;
I fmi2GetIntegerStatus(P m, I k, int *v) | return ERROR;
I fmi2GetBooleanStatus(P m, I k, int *v) | return ERROR;
I fmi2GetStringStatus(P m, I k, S *v) | return ERROR;
"""  # noqa: E501
_THREE = """
typedef void *P; typedef const char *S; typedef int I; typedef const uint32_t *R; typedef size_t N; typedef _Bool B;
S fmi3GetVersion(void) | return "3.0";
I fmi3SetDebugLogging(P m, B on, N n, const S *c) | return OK;
P fmi3InstantiateModelExchange(S name, S token, S place, B shown, B on, P env, P log) | return NULL;
P fmi3InstantiateCoSimulation(S name, S token, S place, B shown, B on, B ev, B early, R r, N n, P env, P log, P mid) | return created(token);
P fmi3InstantiateScheduledExecution(S name, S token, S place, B shown, B on, P env, P log, P a, P b, P c) | return NULL;
void fmi3FreeInstance(P m) | free(m);
I fmi3EnterInitializationMode(P m, B d, double tol, double t, B e, double end) | ((unit *)m)->time = t; return OK;
I fmi3ExitInitializationMode(P m) | return OK;
I fmi3EnterEventMode(P m) | return ERROR;
I fmi3Terminate(P m) | return OK;
I fmi3Reset(P m) | reset(m); return OK;
I fmi3GetFloat64(P m, R r, N n, double *v, N k) | return k == n ? get(m, r, n, v) : ERROR;
I fmi3SetFloat64(P m, R r, N n, const double *v, N k) | return k == n ? set(m, r, n, v) : ERROR;
I fmi3EnterStepMode(P m) | return OK;
I fmi3EnterConfigurationMode(P m) | return ERROR;
I fmi3ExitConfigurationMode(P m) | return ERROR;
I fmi3GetFMUState(P m, P *s) | return ERROR;
I fmi3SetFMUState(P m, P s) | return ERROR;
I fmi3FreeFMUState(P m, P *s) | return ERROR;
I fmi3SerializedFMUStateSize(P m, P s, N *n) | return ERROR;
I fmi3SerializeFMUState(P m, P s, uint8_t *b, N n) | return ERROR;
I fmi3DeserializeFMUState(P m, const uint8_t *b, N n, P *s) | return ERROR;
I fmi3GetNumberOfVariableDependencies(P m, uint32_t r, N *n) | return ERROR;
I fmi3GetVariableDependencies(P m, uint32_t r, N *a, uint32_t *b, N *c, I *d, N n) | return ERROR;
I fmi3GetDirectionalDerivative(P m, R a, N n, R b, N k, const double *s, N ns, double *v, N nv) | return ERROR;
I fmi3GetAdjointDerivative(P m, R a, N n, R b, N k, const double *s, N ns, double *v, N nv) | return ERROR;
I fmi3EvaluateDiscreteStates(P m) | return OK;
I fmi3UpdateDiscreteStates(P m, B *a, B *b, B *c, B *d, B *e, double *f) | return ERROR;
I fmi3EnterContinuousTimeMode(P m) | return ERROR;
I fmi3CompletedIntegratorStep(P m, B a, B *b, B *c) | return ERROR;
I fmi3SetTime(P m, double t) | return ERROR;
I fmi3SetContinuousStates(P m, const double *v, N n) | return ERROR;
I fmi3GetContinuousStateDerivatives(P m, double *v, N n) | return ERROR;
I fmi3GetEventIndicators(P m, double *v, N n) | return ERROR;
I fmi3GetContinuousStates(P m, double *v, N n) | return ERROR;
I fmi3GetNominalsOfContinuousStates(P m, double *v, N n) | return ERROR;
I fmi3GetNumberOfEventIndicators(P m, N *n) | return ERROR;
I fmi3GetNumberOfContinuousStates(P m, N *n) | return ERROR;
I fmi3GetOutputDerivatives(P m, R r, N n, const int32_t *o, double *v, N k) | return ERROR;
I fmi3DoStep(P m, double t, double h, B d, B *ev, B *end, B *early, double *last) | *ev = 0; *end = 0; *early = 0; *last = t + h; return advance(m, t, h);
I fmi3ActivateModelPartition(P m, uint32_t c, double t) | return ERROR;
"""  # noqa: E501
_KINDS = "Float32 Int8 UInt8 Int16 UInt16 Int32 UInt32 Int64 UInt64 Boolean String"


def shell(values: Sequence[float], version: int, token: str) -> str:
    """Text of `fmi.c`.

    Args:
        values: start values of the variables, in the order of their references.
        version: FMI version, 2 or 3.
        token: instantiation token of the unit.
    """
    starts = [repr(value) for value in values]
    text = _COMMON.replace("@STARTS@", ",\n        ".join(starts)).replace("@TOKEN@", token)
    lines = [text.replace("@VERSION@", str(version))]
    for line in (_TWO if version == 2 else _THREE).strip().splitlines():
        head, _, body = line.partition(" | ")
        lines.append(_function(head, body) if body else line)
    if version == 3:
        lines += [_function(*row) for row in _others()]
    return "\n".join([*lines, ""])


def _function(head: str, body: str) -> str:
    inside = head[head.index("(") + 1 : -1]
    names = [] if inside == "void" else re.findall(r"\*?(\w+)(?:,|$)", inside)
    unused = [f"(void){n};" for n in names if not re.search(rf"\b{n}\b", body)]
    return f"EXPORT {head};\nEXPORT {head}\n{{\n    {' '.join([*unused, body])}\n}}"


def _others() -> list[tuple[str, str]]:
    """Getters and setters of the types that the model does not have."""
    rows: list[tuple[str, str]] = []
    for kind in (*_KINDS.split(), "Binary", "Clock"):
        sizes = {"Binary": "P m, R r, N n, N *s, P v, N k", "Clock": "P m, R r, N n, B *v"}
        arguments = sizes.get(kind, "P m, R r, N n, P v, N k")
        for way in ("Get", "Set"):
            rows.append((f"I fmi3{way}{kind}({arguments})", "return n ? ERROR : OK;"))
    for way in ("GetIntervalDecimal", "GetIntervalFraction", "GetShiftDecimal"):
        rows.append((f"I fmi3{way}(P m, R r, N n, P a, P b)", "return ERROR;"))
    for way in ("GetShiftFraction", "SetIntervalFraction", "SetShiftFraction"):
        rows.append((f"I fmi3{way}(P m, R r, N n, P a, P b)", "return ERROR;"))
    for way in ("SetIntervalDecimal", "SetShiftDecimal"):
        rows.append((f"I fmi3{way}(P m, R r, N n, P a)", "return ERROR;"))
    return rows
