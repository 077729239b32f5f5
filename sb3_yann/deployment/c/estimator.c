/* ---- What nothing measures: a Kalman filter whose gain stays ---- */

/* y = table [x; 1] */
static void affine(int rows, int columns, const real table[], const real x[], real y[])
{
    for (int a = 0; a < rows; a++) {
        const real *row = table + (ptrdiff_t)a * (columns + 1);
        y[a] = row[columns];
        for (int j = 0; j < columns; j++) {
            y[a] += row[j] * x[j];
        }
    }
}

/* The estimates after outputs y, NaN where there is none, and the output of the step before. At the
   first step they are at rest where the plant's input is `told`, else at the operating point. */
static void estimate(yann_state *state, const real y[N_OBS], int begins, int told)
{
    real x[N_ESTIMATES + N_OUTPUTS + N_INPUTS + N_LOADS], found[N_ESTIMATES];
    const int own = begins ? N_OUTPUTS : N_ESTIMATES;
    int sound = 1;
    for (int j = 0; j < own; j++) {
        x[j] = !begins ? state->estimate[j] : isfinite(y[j]) ? y[j] : obs_rest[j];
    }
    for (int i = 0; i < N_INPUTS; i++) {
        x[own + i] = state->output[i] * input_scale[i] + input_shift[i];
    }
#if N_LOADS > 0
    for (int i = 0; i < N_LOADS; i++) {
        x[own + N_INPUTS + i] = begins ? state->good[est_loads[i]] : state->load[i];
        state->load[i] = state->good[est_loads[i]]; /* it acts until the next step */
    }
#endif
    if (!begins) {
        affine(N_ESTIMATES, N_ESTIMATES + N_INPUTS + N_LOADS, &est_next[0][0], x, found);
        for (int i = 0; i < N_OUTPUTS; i++) {
            x[i] = y[i];
            for (int j = 0; j < N_ESTIMATES; j++) {
                x[i] -= est_C[i][j] * found[j];
            }
        }
        for (int j = 0; j < N_ESTIMATES; j++) {
            for (int i = 0; i < N_OUTPUTS; i++) {
                found[j] += isfinite(x[i]) ? est_gain[j][i] * x[i] : ZERO;
            }
        }
    } else if (told) {
        affine(N_ESTIMATES, N_OUTPUTS + N_INPUTS + N_LOADS, &est_rest[0][0], x, found);
    } else {
        affine(N_ESTIMATES, N_OUTPUTS, &est_first[0][0], x, found);
    }
    for (int j = 0; j < N_ESTIMATES; j++) {
        sound = sound && isfinite(found[j]);
    }
    if (!sound) {
        affine(N_ESTIMATES, N_OUTPUTS, &est_first[0][0], obs_rest, found);
    }
    for (int j = 0; j < N_ESTIMATES; j++) {
        state->estimate[j] = found[j];
    }
}
