/* Simulates a CSV file: a row of names, then rows of inputs and outputs. Outputs of the
 * first rows start the model, the others are compared with where they are not empty. A
 * column `time` or `t` in s may come first: its step is checked. */
#include "model.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define PAST (ASIA_PAST_INPUTS > ASIA_PAST_OUTPUTS ? ASIA_PAST_INPUTS : ASIA_PAST_OUTPUTS)
#define COLUMNS (ASIA_INPUTS + ASIA_OUTPUTS)

/* 1 for a row, 0 at the end of the file, -1 for one with something that is no number. An
 * empty output is NAN. The time comes first, where there is one; its rows are a sampling
 * time apart. */
static int next_row(FILE *file, asia_real *row, int timed, double *time)
{
    char line[65536];
    char *at = line;
    int i;
    if (fgets(line, sizeof line, file) == NULL || line[strspn(line, " \r\n")] == '\0')
        return 0;
    for (i = -timed; i < COLUMNS; ++i) {
        char *end;
        double value = strtod(at, &end);
        end += strspn(end, " ");
        if (i >= ASIA_INPUTS && end == at + strspn(at, " "))
            value = NAN;
        else if (end == at)
            return -1;
        if (strchr(",\r\n", *end) == NULL)
            return -1;
        if (i < 0)
            *time = value;
        else
            row[i] = (asia_real)value;
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
    double time = 0, before = 0;
    long k, i, timed, found;
    FILE *file;
    if (argc != 2) {
        fprintf(stderr, "usage: model record.csv (%d inputs, then %d outputs)\n", ASIA_INPUTS,
                ASIA_OUTPUTS);
        return 2;
    }
    file = fopen(argv[1], "r");
    if (file == NULL) {
        perror(argv[1]);
        return 2;
    }
    for (i = 1, at = fgets(names, sizeof names, file); at != NULL && *at != '\0'; ++at)
        i += *at == ',';
    timed = i == COLUMNS + 1 && (strncmp(names, "time", 4) == 0 || strncmp(names, "t,", 2) == 0);
    if (i != COLUMNS + timed) {
        fprintf(stderr, "%s: expected the columns @COLUMNS@, separated by commas\n", argv[1]);
        return 2;
    }
    printf("@NAMES@\n");
    for (k = 0; (found = next_row(file, row, (int)timed, &time)) != 0; ++k, before = time) {
        for (i = 0; found == 1 && i < (k < PAST ? COLUMNS : ASIA_INPUTS); ++i)
            found = isnan((double)row[i]) ? -1 : 1;
        if (found != 1) {
            fprintf(stderr, "%s: row %ld has a value that is no number%s\n", argv[1], k + 1,
                    k < PAST ? "; the model starts there" : "");
            return 2;
        }
        if (timed && k && !(fabs(time - before - ASIA_SAMPLING_TIME) <= 0.01 * ASIA_SAMPLING_TIME)) {
            fprintf(stderr, "%s: rows %ld and %ld are %g s apart, the model steps every %g s\n",
                    argv[1], k, k + 1, time - before, (double)ASIA_SAMPLING_TIME);
            return 2;
        }
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
    fprintf(stderr, "%ld samples of %g s, largest difference from the file %.3g\n", k - PAST,
            (double)ASIA_SAMPLING_TIME, (double)worst);
    return 0;
}
