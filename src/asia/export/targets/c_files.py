"""Files around `model.c`."""

from __future__ import annotations

import math
import re

import numpy as np

from asia.export._model import ExportModel, TrainingWindow

MAKEFILE = """# make; ./model example.csv
CFLAGS ?= -std=c99 -Wall -Wextra -pedantic -Werror -O2

model: main.c model.c model.h
\t$(CC) $(CFLAGS) main.c model.c -o model -lm

clean:
\trm -f model

.PHONY: clean
"""

HARNESS = """#include "model.h"

void asia_run(const asia_real *past_u, const asia_real *past_y, const asia_real *u, asia_real *y,
              long samples);

void asia_run(const asia_real *past_u, const asia_real *past_y, const asia_real *u, asia_real *y,
              long samples)
{
    asia_state x;
    long k;
    asia_init(&x, past_u, past_y, u);
    for (k = 0; k < samples; ++k)
        asia_step(&x, u + k * ASIA_INPUTS, y + k * ASIA_OUTPUTS);
}
"""

FLOAT = "typedef float asia_real;"
"""Line of `model.h` that selects single precision; it is replaced by an error where single
precision is not good enough."""
NO_FLOAT = '#error "in float this model differs too much from its simulation in double, see USE.md"'

_HEADER = (
    """/* {title}
 *
 * Sampling time {sampling_time!r} s; inputs are held between samples.
{signals}
 */
#ifndef ASIA_MODEL_H
#define ASIA_MODEL_H

#ifdef ASIA_FLOAT
"""
    + FLOAT
    + """
#else
typedef double asia_real;
#endif

#define ASIA_INPUTS {nu}
#define ASIA_OUTPUTS {ny}
#define ASIA_PAST_INPUTS {past_u}
#define ASIA_PAST_OUTPUTS {past_y}
#define ASIA_SAMPLING_TIME {sampling_time!r}

typedef struct {{
    asia_real x[{states}];
}} asia_state;

/* past_u[ASIA_PAST_INPUTS][ASIA_INPUTS] and past_y[ASIA_PAST_OUTPUTS][ASIA_OUTPUTS], the oldest
 * sample first; u: the input of the first sample to simulate. */
void asia_init(asia_state *x, const asia_real *past_u, const asia_real *past_y,
               const asia_real *u);
/* y of the sample that u belongs to. */
void asia_output(const asia_state *x, const asia_real *u, asia_real *y);
/* From this sample to the next. */
void asia_update(asia_state *x, const asia_real *u);
/* asia_output, then asia_update, in one computation. */
void asia_step(asia_state *x, const asia_real *u, asia_real *y);

#endif
"""
)

_MAIN = r"""/* Simulates a CSV file: a row of names, then rows of inputs and outputs. Outputs of the
 * first rows start the model, the others are compared with. */
#include "model.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define PAST (ASIA_PAST_INPUTS > ASIA_PAST_OUTPUTS ? ASIA_PAST_INPUTS : ASIA_PAST_OUTPUTS)
#define COLUMNS (ASIA_INPUTS + ASIA_OUTPUTS)

static int next_row(FILE *file, asia_real *row)
{
    char line[65536];
    char *at = line;
    int i;
    if (fgets(line, sizeof line, file) == NULL)
        return 0;
    for (i = 0; i < COLUMNS; ++i) {
        char *end;
        row[i] = (asia_real)strtod(at, &end);
        if (end == at)
            return 0;
        at = *end == ',' ? end + 1 : end;
    }
    return 1;
}

int main(int argc, char **argv)
{
    static asia_real past_u[ASIA_PAST_INPUTS * ASIA_INPUTS + 1];
    static asia_real past_y[ASIA_PAST_OUTPUTS * ASIA_OUTPUTS + 1];
    asia_real row[COLUMNS], y[ASIA_OUTPUTS], worst = 0;
    asia_state x;
    char names[65536], *at;
    long k, i;
    FILE *file = argc == 2 ? fopen(argv[1], "r") : NULL;
    if (file == NULL) {
        fprintf(stderr, "usage: model record.csv (%d inputs, then %d outputs)\n", ASIA_INPUTS,
                ASIA_OUTPUTS);
        return 2;
    }
    for (i = 1, at = fgets(names, sizeof names, file); at != NULL && *at != '\0'; ++at)
        i += *at == ',';
    if (i != COLUMNS) {
        fprintf(stderr, "%s: expected the columns {columns}, separated by commas\n", argv[1]);
        return 2;
    }
    printf("{names}\n");
    for (k = 0; next_row(file, row); ++k) {
        long from_u = k - (PAST - ASIA_PAST_INPUTS), from_y = k - (PAST - ASIA_PAST_OUTPUTS);
        if (k < PAST) {
            if (from_u >= 0)
                memcpy(past_u + from_u * ASIA_INPUTS, row, ASIA_INPUTS * sizeof *row);
            if (from_y >= 0)
                memcpy(past_y + from_y * ASIA_OUTPUTS, row + ASIA_INPUTS,
                       ASIA_OUTPUTS * sizeof *row);
            continue;
        }
        if (k == PAST)
            asia_init(&x, past_u, past_y, row);
        asia_step(&x, row, y);
        for (i = 0; i < ASIA_OUTPUTS; ++i) {
            double gap = fabs((double)(y[i] - row[ASIA_INPUTS + i]));
            printf("%s%.17g", i ? "," : "", (double)y[i]);
            if (gap > (double)worst)
                worst = (asia_real)gap;
        }
        printf("\n");
    }
    fclose(file);
    if (k <= PAST) {
        fprintf(stderr, "%s: expected more than %d rows of numbers, found %ld\n", argv[1], PAST, k);
        return 2;
    }
    fprintf(stderr, "%ld samples, largest difference from the file %.3g\n", k - PAST,
            (double)worst);
    return 0;
}
"""


def header(model: ExportModel) -> str:
    """Text of `model.h`."""
    low = model.lowered
    rows = [
        f" * {side} {i}: {_plain(s.name)} {_plain(s.unit)}, trained from {a:g} to {b:g}"
        for side, signals, span in (
            ("input", model.inputs, model.input_range),
            ("output", model.outputs, model.output_range),
        )
        for i, (s, (a, b)) in enumerate(zip(signals, span.tolist(), strict=True))
    ]
    return _HEADER.format(
        title=_plain(f"{model.problem}: {model.use} of run {model.name}"),
        signals="\n".join(rows),
        sampling_time=model.sampling_time,
        nu=low.nu,
        ny=low.ny,
        past_u=low.n_past_u,
        past_y=low.n_past_y,
        states=max(sum(math.prod(s) for s in low.states), 1),
    )


def main_file(model: ExportModel) -> str:
    """Text of `main.c`."""
    columns = ",".join(_plain(s.name) for s in (*model.inputs, *model.outputs))
    names = ",".join(_plain(s.name) for s in model.outputs)
    return _MAIN.replace("{names}", names).replace("{columns}", columns)


def example_csv(model: ExportModel, window: TrainingWindow) -> str:
    """Window in the CSV format of `main.c`: the outputs after its past are those of ASIA's
    simulation."""
    past = max(len(window.past_u), len(window.past_y))
    u = np.concatenate([np.zeros((past - len(window.past_u), model.lowered.nu)), window.past_u])
    y = np.concatenate([np.zeros((past - len(window.past_y), model.lowered.ny)), window.past_y])
    rows = np.concatenate(
        [np.concatenate([u, window.u]), np.concatenate([y, window.y_hat])], axis=1
    )
    names = ",".join(_plain(s.name) for s in (*model.inputs, *model.outputs))
    return "\n".join([names, *(",".join(repr(float(v)) for v in row) for row in rows), ""])


def _plain(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9 _.:/^-]", "_", text)
