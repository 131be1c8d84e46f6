// The substeps of one robosuite control step under operational-space control, with MuJoCo's own functions.
//
// Bit-equal to robosuite 1.5.2's Python: each product is the BLAS or LAPACK call that numpy or numba makes there, on the same
// numbers in the same layout; sums and products of elements are in its order and must not be fused (-ffp-contract=off).
// Layouts: robosuite's Jacobians are C-ordered, its mass matrix, what LAPACK returns and pseudo-inverses Fortran-ordered.

#include <cmath>
#include <csetjmp>
#include <cstdint>
#include <cstring>

namespace {

constexpr int kMaxJoints = 8;
constexpr int kMaxWork = 4096;  // f64, of LAPACK
constexpr int kRowMajor = 101, kColumnMajor = 102, kNoTranspose = 111;  // of CBLAS

using Step = void (*)(const void*, void*);
using FullM = void (*)(const void*, double*, const double*);
using JacSite = void (*)(const void*, const void*, double*, double*, int);
using Handler = void (*)(const char*);
using SetHandler = void (*)(Handler);
using CblasGemv = void (*)(int, int, int64_t, int64_t, double, const double*, int64_t, const double*, int64_t, double,
                           double*, int64_t);
using Gemm = void (*)(char*, char*, int*, int*, int*, double*, double*, int*, double*, int*, double*, double*, int*);
using Gemv = void (*)(char*, int*, int*, double*, double*, int*, double*, int*, double*, double*, int*);
using Getrf = void (*)(int*, int*, double*, int*, int*, int*);
using Getri = void (*)(int*, double*, int*, int*, double*, int*, int*);
using Gesdd = void (*)(char*, int*, int*, double*, int*, double*, double*, int*, double*, int*, double*, int*, int*, int*);

}  // namespace

extern "C" {

struct Functions {
    Step step1, step2;
    FullM full_m;
    JacSite jac_site;
    SetHandler set_handler;
    CblasGemv numpy_gemv;
    Gemm gemm;
    Gemv gemv;
    Getrf getrf;
    Getri getri;
    Gesdd gesdd;
};

// One arm: where it is in the simulation, what it is to do, and what its controller looks at. n joints.
struct Arm {
    int64_t site, n;
    const int64_t *qpos, *qvel, *actuators;
    const double *goal;        // [3] position, [9] rotation, [6] kp, [6] kd, [n] joints of the null space
    double *position, *rotation, *velocity, *turning;  // of the site: [3] [9] [3] [3]
    double *j_pos, *j_ori, *j_full;  // [3, n] [3, n] [6, n]
    double *joints, *speeds, *mass, *torques;  // [n] [n] [n, n] in Fortran order, [n]
};

struct World {
    const void* model;
    void* data;
    int64_t nv, arms;
    const double *site_xpos, *site_xmat, *qpos, *qvel, *qm, *bias, *ctrlrange;
    double *ctrl, *inertia, *jacobians;  // the last two are for the work: [nv, nv] [6, nv]
    const Arm* arm;
};

}  // extern "C"

namespace {

thread_local jmp_buf g_out;
thread_local char g_error[512];

void on_error(const char* message) {
    strncpy(g_error, message, sizeof g_error - 1);
    longjmp(g_out, 1);
}

bool finite(const double* x, int n) {
    for (int i = 0; i < n; ++i)
        if (!std::isfinite(x[i])) return false;
    return true;
}

// numba's np.dot of two matrices, [m, k] and [k, n], whose result is C-ordered; `c` says which operands are.
void dot(const Functions& f, double* a, bool a_c, double* b, bool b_c, double* out, int m, int k, int n) {
    char t = 't', plain = 'n';
    double one = 1.0, zero = 0.0;
    int lda = a_c ? k : m, ldb = b_c ? n : k;
    f.gemm(b_c ? &plain : &t, a_c ? &plain : &t, &n, &m, &k, &one, b, &ldb, a, &lda, &zero, out, &n);
}

// numba's np.dot of a Fortran-ordered square matrix and a vector.
void dot(const Functions& f, double* a, double* x, double* out, int n) {
    char plain = 'n';
    double one = 1.0, zero = 0.0;
    int inc = 1;
    f.gemv(&plain, &n, &n, &one, a, &n, x, &inc, &zero, out, &inc);
}

// How much work LAPACK wants for matrices of each size, which it tells once: it depends on nothing else.
thread_local int g_inverse_work[kMaxJoints + 1], g_pseudo_work[7];

// numba's np.linalg.inv of a Fortran-ordered matrix.
bool inverse(const Functions& f, const double* a, double* out, int n) {
    int pivots[kMaxJoints], info = 0, lwork = -1;
    double work[kMaxWork];
    if (!finite(a, n * n)) return false;
    memcpy(out, a, sizeof(double) * n * n);
    f.getrf(&n, &n, out, &n, pivots, &info);
    if (info) return false;
    if (!g_inverse_work[n]) {
        f.getri(&n, out, &n, pivots, work, &lwork, &info);
        g_inverse_work[n] = static_cast<int>(work[0]);
    }
    lwork = g_inverse_work[n];
    if (lwork > kMaxWork) return false;
    f.getri(&n, out, &n, pivots, work, &lwork, &info);
    return info == 0;
}

// numba's np.linalg.pinv of a C-ordered matrix; the result is Fortran-ordered.
bool pseudo_inverse(const Functions& f, const double* a, double* out, int n) {
    double u[36], s[6], vt[36], work[kMaxWork];
    double one = 1.0, zero = 0.0;
    int iwork[48], info = 0, lwork = -1;
    char job = 'S', c = 'C';
    if (!finite(a, n * n)) return false;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) out[j * n + i] = a[i * n + j];
    if (!g_pseudo_work[n]) {
        f.gesdd(&job, &n, &n, out, &n, s, u, &n, vt, &n, work, &lwork, iwork, &info);
        g_pseudo_work[n] = static_cast<int>(work[0]);
    }
    lwork = g_pseudo_work[n];
    if (lwork > kMaxWork) return false;
    f.gesdd(&job, &n, &n, out, &n, s, u, &n, vt, &n, work, &lwork, iwork, &info);
    if (info) return false;
    double cut_at = s[0] * 1e-15;
    int kept = 0;
    for (int k = 0; k < n; ++k)
        if (s[k] > cut_at) {
            s[k] = 1.0 / s[k];
            kept = k;
        }
    ++kept;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < kept; ++j) vt[i * n + j] = vt[i * n + j] * s[j];
    f.gemm(&c, &c, &n, &n, &kept, &one, vt, &n, u, &n, &zero, out, &n);
    return true;
}

// robosuite's Controller.update without its copies; `w.inertia` is there.
void look(const Functions& f, const World& w, const Arm& arm) {
    const int n = static_cast<int>(arm.n);
    const int64_t nv = w.nv;
    memset(w.jacobians, 0, sizeof(double) * 6 * nv);
    f.jac_site(w.model, w.data, w.jacobians, w.jacobians + 3 * nv, static_cast<int>(arm.site));
    memcpy(arm.position, w.site_xpos + 3 * arm.site, sizeof(double) * 3);
    memcpy(arm.rotation, w.site_xmat + 9 * arm.site, sizeof(double) * 9);
    f.numpy_gemv(kRowMajor, kNoTranspose, 3, nv, 1.0, w.jacobians, nv, w.qvel, 1, 0.0, arm.velocity, 1);
    f.numpy_gemv(kRowMajor, kNoTranspose, 3, nv, 1.0, w.jacobians + 3 * nv, nv, w.qvel, 1, 0.0, arm.turning, 1);
    for (int row = 0; row < 6; ++row)
        for (int j = 0; j < n; ++j) arm.j_full[row * n + j] = w.jacobians[row * nv + arm.qvel[j]];
    memcpy(arm.j_pos, arm.j_full, sizeof(double) * 3 * n);
    memcpy(arm.j_ori, arm.j_full + 3 * n, sizeof(double) * 3 * n);
    for (int i = 0; i < n; ++i) {
        arm.joints[i] = w.qpos[arm.qpos[i]];
        arm.speeds[i] = w.qvel[arm.qvel[i]];
        for (int j = 0; j < n; ++j) arm.mass[j * n + i] = w.inertia[arm.qvel[i] * nv + arm.qvel[j]];
    }
}

// Half the sum of the cross products of columns, as robosuite's orientation_error.
void rotation_error(const double* desired, const double* current, double* out) {
    double crosses[3][3];
    for (int column = 0; column < 3; ++column) {
        const double *a = current + column, *b = desired + column;
        double* c = crosses[column];
        c[0] = a[3] * b[6] - a[6] * b[3];
        c[1] = a[6] * b[0] - a[0] * b[6];
        c[2] = a[0] * b[3] - a[3] * b[0];
    }
    for (int i = 0; i < 3; ++i) out[i] = 0.5 * ((crosses[0][i] + crosses[1][i]) + crosses[2][i]);
}

// robosuite's OperationalSpaceController.run_controller with position and rotation uncoupled; false where it raises.
bool torques(const Functions& f, const World& w, const Arm& arm) {
    const int n = static_cast<int>(arm.n);
    const double *goal = arm.goal, *turned = goal + 3, *kp = goal + 12, *kd = goal + 18, *initial = goal + 24;
    double error[6], wanted[6], wrench[6];
    for (int i = 0; i < 3; ++i) error[i] = goal[i] - arm.position[i];
    rotation_error(turned, arm.rotation, error + 3);
    for (int i = 0; i < 6; ++i) {
        const double against = -(i < 3 ? arm.velocity[i] : arm.turning[i - 3]);
        wanted[i] = error[i] * kp[i] + against * kd[i];
    }

    double inverted[64], product[48], inner[36], full[36], place[9], turn[9], jbar[48], bar[48], null[64];
    if (!inverse(f, arm.mass, inverted, n)) return false;
    dot(f, arm.j_full, true, inverted, false, product, 6, n, n);
    dot(f, product, true, arm.j_full, false, inner, 6, n, 6);
    if (!pseudo_inverse(f, inner, full, 6)) return false;
    dot(f, arm.j_pos, true, inverted, false, product, 3, n, n);
    dot(f, product, true, arm.j_pos, false, inner, 3, n, 3);
    if (!pseudo_inverse(f, inner, place, 3)) return false;
    dot(f, arm.j_ori, true, inverted, false, product, 3, n, n);
    dot(f, product, true, arm.j_ori, false, inner, 3, n, 3);
    if (!pseudo_inverse(f, inner, turn, 3)) return false;
    dot(f, inverted, false, arm.j_full, false, bar, n, n, 6);
    dot(f, bar, true, full, false, jbar, n, 6, 6);
    dot(f, jbar, true, arm.j_full, true, null, n, 6, n);
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) null[i * n + j] = (i == j ? 1.0 : 0.0) - null[i * n + j];

    f.numpy_gemv(kColumnMajor, kNoTranspose, 3, 3, 1.0, place, 3, wanted, 1, 0.0, wrench, 1);
    f.numpy_gemv(kColumnMajor, kNoTranspose, 3, 3, 1.0, turn, 3, wanted + 3, 1, 0.0, wrench + 3, 1);
    f.numpy_gemv(kColumnMajor, kNoTranspose, n, 6, 1.0, arm.j_full, n, wrench, 1, 0.0, arm.torques, 1);

    const double kv = std::sqrt(10.0) * 2;
    double posture[kMaxJoints], pose[kMaxJoints], rest[kMaxJoints];
    for (int i = 0; i < n; ++i) posture[i] = 10.0 * (initial[i] - arm.joints[i]) - kv * arm.speeds[i];
    dot(f, arm.mass, posture, pose, n);
    dot(f, null, pose, rest, n);
    for (int i = 0; i < n; ++i) {
        arm.torques[i] = (arm.torques[i] + w.bias[arm.qvel[i]]) + rest[i];
        const int64_t actuator = arm.actuators[i];
        const double low = w.ctrlrange[2 * actuator], high = w.ctrlrange[2 * actuator + 1];
        double torque = arm.torques[i];
        torque = torque < low ? low : torque;
        w.ctrl[actuator] = torque > high ? high : torque;
    }
    return true;
}

bool control(const Functions& f, const World& w) {
    f.full_m(w.model, w.inertia, w.qm);
    for (int64_t i = 0; i < w.arms; ++i) {
        look(f, w, w.arm[i]);
        if (!torques(f, w, w.arm[i])) return false;
    }
    return true;
}

}  // namespace

extern "C" {

// Look at all arms in the present state, after mj_step1.
__attribute__((visibility("default"))) void period_look(const Functions* f, const World* w) {
    f->full_m(w->model, w->inertia, w->qm);
    for (int64_t i = 0; i < w->arms; ++i) look(*f, *w, w->arm[i]);
}

// Write one arm's torques for the present state, after mj_step1; 0 where robosuite's own would raise.
__attribute__((visibility("default"))) int period_control(const Functions* f, const World* w, int64_t arm) {
    f->full_m(w->model, w->inertia, w->qm);
    look(*f, *w, w->arm[arm]);
    return torques(*f, *w, w->arm[arm]);
}

// Take up to `n` substeps; return how many, fewer where torques cannot be had: then mj_step1 of the next one has been taken.
// -1 if MuJoCo gave up, which `period_error` explains.
__attribute__((visibility("default"))) int64_t period_advance(const Functions* f, const World* w, int64_t n) {
    volatile int64_t taken = 0;
    f->set_handler(on_error);
    if (setjmp(g_out)) {
        f->set_handler(nullptr);
        return -1;
    }
    for (; taken < n; taken = taken + 1) {
        f->step1(w->model, w->data);
        if (!control(*f, *w)) break;
        f->step2(w->model, w->data);
    }
    f->set_handler(nullptr);
    return taken;
}

// Tells whether Python's structures are of the sizes of these.
__attribute__((visibility("default"))) int period_layout() {
    return static_cast<int>(sizeof(Functions) + (sizeof(Arm) << 8) + (sizeof(World) << 16));
}

__attribute__((visibility("default"))) const char* period_error() { return g_error; }
}
