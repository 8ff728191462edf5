/* Simulates a CSV file: a row of names, then rows of inputs and outputs. Outputs of the
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
    if (i != COLUMNS) {
        fprintf(stderr, "%s: expected the columns @COLUMNS@, separated by commas\n", argv[1]);
        return 2;
    }
    printf("@NAMES@\n");
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
