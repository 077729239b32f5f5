/* ---- The program of the law, solved at theta by a dual active-set method ---- */

/* Goldfarb & Idnani, Math. Programming 27 (1983). Scratch memory: one step at a time. */
static real qp_factor[QP_ROOM][QP_ROOM], qp_d[QP_ROWS], qp_slack[QP_ROWS];
static real qp_lam[QP_ROOM], qp_step[QP_ROOM], qp_column[QP_ROOM];
static int qp_active[QP_ROOM];

static real qp_extra(int row, int soft) { return soft ? qp_softness[row] : ZERO; }

/* Rows first to size of the Cholesky factor of the active constraints; 0 where there is none. */
static int qp_factorize(int first, int size, int soft)
{
    for (int i = first; i < size; i++) {
        for (int j = 0; j <= i; j++) {
            real total = qp_gram[qp_active[i]][qp_active[j]];
            total += i == j ? qp_extra(qp_active[i], soft) : ZERO;
            for (int k = 0; k < j; k++) {
                total -= qp_factor[i][k] * qp_factor[j][k];
            }
            if (i > j) {
                qp_factor[i][j] = total / qp_factor[j][j];
            } else if (total > ZERO) {
                qp_factor[i][i] = sqrt(total);
            } else {
                return 0;
            }
        }
    }
    return 1;
}

static void qp_lower(int size, real x[])
{
    for (int i = 0; i < size; i++) {
        for (int k = 0; k < i; k++) {
            x[i] -= qp_factor[i][k] * x[k];
        }
        x[i] /= qp_factor[i][i];
    }
}

static void qp_upper(int size, real x[])
{
    for (int i = size - 1; i >= 0; i--) {
        for (int k = i + 1; k < size; k++) {
            x[i] -= qp_factor[k][i] * x[k];
        }
        x[i] /= qp_factor[i][i];
    }
}

static void qp_slacks(int size)
{
    for (int j = 0; j < QP_ROWS; j++) {
        qp_slack[j] = qp_d[j];
    }
    for (int i = 0; i < size; i++) {
        for (int j = 0; j < QP_ROWS; j++) {
            qp_slack[j] += qp_lam[i] * qp_gram[qp_active[i]][j];
        }
    }
    for (int i = 0; i < size; i++) {
        qp_slack[qp_active[i]] = ZERO;
    }
}

/* Take a constraint in, others out; return how many are active, -1 where that cannot be. */
static int qp_add(int entering, real violation, int size, int most, int soft)
{
    real own = ZERO;
    while (1) {
        real rest = ONE + qp_extra(entering, soft), length = INFINITY;
        int leaving = -1;
        for (int i = 0; i < size; i++) {
            qp_step[i] = qp_gram[entering][qp_active[i]];
        }
        qp_lower(size, qp_step);
        for (int i = 0; i < size; i++) {
            rest -= qp_step[i] * qp_step[i];
            qp_column[i] = qp_step[i];
        }
        qp_upper(size, qp_step);
        for (int i = 0; i < size; i++) {
            if (qp_step[i] > ZERO && qp_lam[i] < length * qp_step[i]) {
                length = qp_lam[i] / qp_step[i];
                leaving = i;
            }
        }
        const real full = rest > 1e-11 ? violation / rest : (real)INFINITY;
        const int is_full = full <= length;
        length = is_full ? full : length;
        if (!(length < (real)INFINITY) || (is_full && size == most)) {
            return -1;
        }
        for (int i = 0; i < size; i++) {
            qp_lam[i] -= length * qp_step[i];
            qp_lam[i] = qp_lam[i] > ZERO ? qp_lam[i] : ZERO;
        }
        own += length;
        if (is_full) {
            for (int i = 0; i < size; i++) {
                qp_factor[size][i] = qp_column[i];
            }
            qp_factor[size][size] = sqrt(rest);
            qp_active[size] = entering;
            qp_lam[size] = own;
            return size + 1;
        }
        violation -= rest > 1e-11 ? length * rest : ZERO;
        size--; /* so that this ends */
        for (int i = leaving; i < size; i++) {
            qp_active[i] = qp_active[i + 1];
            qp_lam[i] = qp_lam[i + 1];
        }
        if (!qp_factorize(leaving, size, soft)) {
            return -1;
        }
    }
}

/*
 * Solve anew for the active set in ascending order; return whether all conditions hold. Where
 * constraints give way multipliers are a million times as large as d, and sums of them round.
 */
static int qp_is_optimal(int size, int soft)
{
    const real tolerance = soft ? 1e-6 : 1e-9;
    real largest = ZERO, least = ZERO;
    for (int j = 0; soft && j < QP_ROWS; j++) {
        least = FABS(qp_d[j]) > least ? FABS(qp_d[j]) : least;
    }
    for (int i = 1; i < size; i++) {
        const int own = qp_active[i];
        int k = i;
        for (; k > 0 && qp_active[k - 1] > own; k--) {
            qp_active[k] = qp_active[k - 1];
        }
        qp_active[k] = own;
    }
    if (!qp_factorize(0, size, soft)) {
        return 0;
    }
    for (int i = 0; i < size; i++) {
        qp_lam[i] = -qp_d[qp_active[i]];
    }
    qp_lower(size, qp_lam);
    qp_upper(size, qp_lam);
    for (int i = 0; i < size; i++) {
        largest = FABS(qp_lam[i]) > largest ? FABS(qp_lam[i]) : largest;
    }
    for (int i = 0; i < size; i++) {
        if (!(qp_lam[i] >= -tolerance * (ONE + largest))) {
            return 0;
        }
        qp_lam[i] = qp_lam[i] > ZERO ? qp_lam[i] : ZERO;
    }
    for (int i = 0; i < size; i++) {
        const int row = qp_active[i];
        real rest = qp_d[row] + qp_extra(row, soft) * qp_lam[i];
        for (int k = 0; k < size; k++) {
            rest += qp_gram[row][qp_active[k]] * qp_lam[k];
        }
        if (!(FABS(rest) <= tolerance * (ONE + (soft ? least : FABS(qp_d[row]))))) {
            return 0;
        }
    }
    qp_slacks(size);
    for (int j = 0; j < QP_ROWS; j++) {
        if (!(qp_slack[j] >= -tolerance * (ONE + (soft ? least : FABS(qp_d[j]))))) {
            return 0;
        }
    }
    return 1;
}

/* Write what constraints take from the law without any; return whether that is the optimum. */
static int qp_solve(const real theta[N_THETA], int soft, real less[N_INPUTS])
{
    const int most = soft ? QP_ROWS : QP_MOST;
    int size = 0, solved = 0;
    for (int j = 0; j < QP_ROWS; j++) {
        qp_d[j] = qp_d0[j];
        for (int i = 0; i < N_THETA; i++) {
            qp_d[j] += theta[i] * qp_D[i][j];
        }
    }
    qp_slacks(0);
    real far = ZERO; /* beside the largest violation 1e-8 is rounding where constraints give way */
    for (int j = 0; j < QP_ROWS; j++) {
        far = -qp_d[j] > far ? -qp_d[j] : far;
    }
    for (int count = 0; count < QP_STEPS && size >= 0; count++) {
        int worst = -1;
        real lowest = ZERO;
        for (int j = 0; j < QP_ROWS; j++) {
            const real room = soft ? 1e-8 * (ONE + far) : 1e-10 * (ONE + FABS(qp_d[j]));
            if (qp_slack[j] < lowest && qp_slack[j] < -room) {
                worst = j;
                lowest = qp_slack[j];
            }
        }
        if (worst < 0) {
            solved = qp_is_optimal(size, soft);
            break;
        }
        size = qp_add(worst, -lowest, size, most, soft);
        if (size >= 0) {
            qp_slacks(size);
        }
    }
    for (int i = 0; i < N_INPUTS; i++) {
        less[i] = ZERO;
        for (int k = 0; k < size && solved; k++) {
            less[i] += qp_E[qp_active[k]][i] * qp_lam[k];
        }
    }
    return solved;
}

/*
 * The same; where the program has no solution constraints give way, and the result is -1, else 1.
 * Where that cannot be solved either, within QP_STEPS steps, the law without constraints acts.
 */
static real solve(const real theta[N_THETA], real less[N_INPUTS])
{
    int solved = qp_solve(theta, 0, less);
#if QP_FIXED > 0
    for (int k = 0; k < QP_FIXED; k++) {
        real slack = qp_fixed[k][N_THETA];
        for (int i = 0; i < N_THETA; i++) {
            slack += qp_fixed[k][i] * theta[i];
        }
        solved = solved && slack >= -1e-11;
    }
#endif
#if !ZERO_INPUT
    if (!solved) {
        (void)qp_solve(theta, 1, less);
    }
#endif
    return solved ? ONE : -ONE;
}
