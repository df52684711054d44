/* An ORCA-Quest for the fake library: its properties, its ring, its trigger input.
 *
 * Pixels say where and when they were taken: four bits of the framestamp, six of the sensor row, six of the sensor column.
 * Row padding is 0xEE. A frame is in the ring an exposure and a readout after its trigger. Time is virtual (a wait jumps to
 * the next thing that happens) or real. The world outside acts through fake_world.h. */
#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define PULSE_WIDTH 1e-3
#define LONG_AGO (-1e9)

enum { ST_BUSY = 1, ST_READY = 2, ST_STABLE = 3 };
enum { EV_FRAMEREADY = 2, EV_STOPPED = 16 };

/* Properties: access by state (S always for writable ones), value type, range, the values of a mode. */
enum { RO = 0, S = 0x20000, SR = 0x22000, SRB = 0x23000 };
enum { MODE = 1, LONG = 2, REAL = 3, ROUNDS = 0x800000 };
typedef struct { int32_t id, access, type; double min, max, step, initial; int legal[4]; double value; } Property;
enum {
    TRIGGERSOURCE, TRIGGERACTIVE, TRIGGER_MODE, TRIGGERPOLARITY, TRIGGERTIMES, TRIGGERDELAY, GLOBALEXPOSURE, EXPOSURETIME,
    TEMPERATURE, COOLERSTATUS, READOUTSPEED, SENSORMODE, BINNING, HPOS, HSIZE, VPOS, VSIZE, SUBARRAYMODE, READOUTTIME, CYCLIC,
    BLANKING, MININTERVAL, FRAMEINTERVAL, BITS, WIDTH, HEIGHT, ROWBYTES, PIXELTYPE, FRAMEBYTES, BUNDLE, TIMEPRODUCER,
    STAMPPRODUCER, DEFECT, HOTPIXEL, COEFF, OFFSET, N_PROPS
};
static const Property TABLE[N_PROPS] = {
    [TRIGGERSOURCE] = {0x00100110, SRB, MODE, 1, 4, 1, 1, {1, 2, 3, 4}},
    [TRIGGERACTIVE] = {0x00100120, SR, MODE, 1, 3, 1, 1, {1, 2, 3}},
    [TRIGGER_MODE] = {0x00100210, SR, MODE, 1, 6, 1, 1, {1, 6}},
    [TRIGGERPOLARITY] = {0x00100220, SRB, MODE, 1, 2, 1, 1, {1, 2}},
    [TRIGGERTIMES] = {0x00100240, SRB, LONG, 1, 10000, 1, 1},
    [TRIGGERDELAY] = {0x00100260, SRB, REAL, 0, 10, 1e-6, 0},
    [GLOBALEXPOSURE] = {0x001F0300, S, MODE, 3, 5, 1, 3, {3, 5}},
    [EXPOSURETIME] = {0x001F0110, SRB, REAL | ROUNDS, 7.2e-6, 1800, 1e-8, 8.2944e-3},
    [TEMPERATURE] = {0x00200310, RO, REAL, -50, 100, 0.1, -20},
    [COOLERSTATUS] = {0x00200340, RO, MODE, -4, 5, 1, 2, {1, 2, 3, 4}},
    [READOUTSPEED] = {0x00400110, S, MODE, 1, 2, 1, 2, {1, 2}},
    [SENSORMODE] = {0x00400210, S, MODE, 1, 18, 1, 1, {1, 12, 18}},
    [BINNING] = {0x00401110, S, MODE, 1, 4, 1, 1, {1, 2, 4}},
    [HPOS] = {0x00402110, S, LONG | ROUNDS, 0, 0, 4, 0},
    [HSIZE] = {0x00402120, S, LONG | ROUNDS, 4, 0, 4, 0},
    [VPOS] = {0x00402130, S, LONG | ROUNDS, 0, 0, 4, 0},
    [VSIZE] = {0x00402140, S, LONG | ROUNDS, 4, 0, 4, 0},
    [SUBARRAYMODE] = {0x00402150, S, MODE, 1, 2, 1, 1, {1, 2}},
    [READOUTTIME] = {0x00403010, RO, REAL},
    [CYCLIC] = {0x00403020, RO, REAL},
    [BLANKING] = {0x00403030, RO, REAL},
    [MININTERVAL] = {0x00403050, RO, REAL},
    [FRAMEINTERVAL] = {0x00403820, RO, REAL},
    [BITS] = {0x00420130, S, MODE, 8, 16, 4, 16, {8, 12, 16}},
    [WIDTH] = {0x00420210, RO, LONG},
    [HEIGHT] = {0x00420220, RO, LONG},
    [ROWBYTES] = {0x00420230, RO, LONG},
    [PIXELTYPE] = {0x00420270, S, MODE, 1, 2, 1, 2, {1, 2}},
    [FRAMEBYTES] = {0x00420340, RO, LONG},
    [BUNDLE] = {0x00421010, RO, MODE, 1, 2, 1, 1, {1, 2}},
    [TIMEPRODUCER] = {0x00410A10, RO, MODE, 1, 5, 1, 5, {5}},
    [STAMPPRODUCER] = {0x00410A20, RO, MODE, 1, 5, 1, 5, {5}},
    [DEFECT] = {0x00470010, SRB, MODE, 1, 2, 1, 2, {1, 2}},
    [HOTPIXEL] = {0x00470030, SRB, MODE, 1, 3, 1, 1, {1, 2, 3}},
    [COEFF] = {0x00FFE010, RO, REAL, 0, 1, 0, 0.107},
    [OFFSET] = {0x00FFE020, RO, REAL, 0, 1000, 0, 200},
};

/* What the outside can do to the camera and its library. */
static const char *const FAULTS[] = {"no_camera", "unplugged", "unplug_at", "report_loss", "pad", "first_stamp", "start_polls",
                                     "overrun_in_lock", "swallow_events", "refuse", "unsupported", "no_memory",
                                     "no_stopped_event", "no_stamps", "short_ring", "drop", "slow_to_wake", "stamps_go_on",
                                     "count_back", "odd_status"};
enum { NO_CAMERA, UNPLUGGED, UNPLUG_AT, REPORT_LOSS, PAD, FIRST_STAMP, START_POLLS, OVERRUN_IN_LOCK, SWALLOW, REFUSE, UNSUPPORTED,
       NO_MEMORY, NO_STOPPED_EVENT, NO_STAMPS, SHORT_RING, DROP, SLOW_TO_WAKE, STAMPS_GO_ON, COUNT_BACK, ODD_STATUS, N_FAULTS };

enum { MAX_PULSES = 4096, MAX_HANDLES = 1 << 16, MAX_CALLS = 64 };
static char handles[MAX_HANDLES]; /* their addresses are the handles; none is given out twice, so that old ones are known */
static struct {
    Property props[N_PROPS];
    int overridden[N_PROPS], faults[N_FAULTS];
    double override[N_PROPS];
    int sensor_rows, sensor_cols, devices, n_handles;
    int session, status, mode, polls, waiters, aborts, pending;
    void *camera, *wait; /* NULL where closed */
    int slots, count, exposed, edges, externals, life; /* externals: exposures by external trigger
                                                             over the camera's life; life: all exposures */
    uint8_t **ring;
    int32_t *stamps;
    double *times, last_edge, open_edge, started, boot, virtual_now; /* virtual_now 0: real time */
    double pulses[MAX_PULSES], looked; /* looked: time of the last pulse taken off the cable */
    double (*cable)(double after);     /* time of the first pulse later than that; negative for none */
    int n_pulses, seen;
    unsigned char lost[1 << 16]; /* external exposures that never reach the ring */
    struct { double begin, ready; int stamp; } flying[4]; /* exposed, not yet read out */
    int n_flying;
    struct { const char *name; int count, fail_in; int32_t code; } calls[MAX_CALLS];
} fake;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t changed = PTHREAD_COND_INITIALIZER;

static double now(void) {
    if (fake.virtual_now > 0) return fake.virtual_now;
    struct timespec t;
    clock_gettime(CLOCK_REALTIME, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static int is(int p, int value) { return fake.props[p].value == value; }

static int counts_photons(void) { return is(SENSORMODE, 18); }

static int slow(void) { return is(READOUTSPEED, 1) || counts_photons(); }

static double get(int p) {
    if (fake.overridden[p]) return fake.override[p];
    int binning = (int)fake.props[BINNING].value;
    int rows = is(SUBARRAYMODE, 2) ? (int)fake.props[VSIZE].value : fake.sensor_rows;
    int cols = is(SUBARRAYMODE, 2) ? (int)fake.props[HSIZE].value : fake.sensor_cols;
    double line = slow() ? 172.8e-6 : 7.2e-6, exposure = fake.props[EXPOSURETIME].value;
    switch (p) {
    case READOUTTIME: return rows / 2 * line;
    case BLANKING: return (rows / 2 + 5) * line;
    case CYCLIC: case MININTERVAL: return (is(TRIGGERACTIVE, 1) ? exposure : 0) + (rows / 2 + 5) * line;
    case FRAMEINTERVAL: return fmax(exposure, (rows / 2 + 5) * line);
    case WIDTH: return cols / binning;
    case HEIGHT: return rows / binning;
    case ROWBYTES: return cols / binning * 2 + fake.faults[PAD];
    case FRAMEBYTES: return get(ROWBYTES) * get(HEIGHT);
    case READOUTSPEED: return slow() ? 1 : 2;
    case COEFF: return counts_photons() ? 1 : fake.props[p].value;
    case OFFSET: return counts_photons() ? 0 : fake.props[p].value;
    default: return fake.props[p].value;
    }
}

static double highest(int p) { /* strict: a position leaves less room for the size, and the other way round */
    switch (p) {
    case HPOS: return fake.sensor_cols - fake.props[HSIZE].value;
    case VPOS: return fake.sensor_rows - fake.props[VSIZE].value;
    case HSIZE: return fake.sensor_cols - fake.props[HPOS].value;
    case VSIZE: return fake.sensor_rows - fake.props[VPOS].value;
    default: return fake.props[p].max;
    }
}

static int capturing(void) { return fake.status == ST_BUSY && fake.polls >= fake.faults[START_POLLS]; }

static void deliver(void) { /* the oldest exposed frame, into the ring */
    int slot = fake.count % fake.slots, rows = (int)get(HEIGHT), cols = (int)get(WIDTH), stride = (int)get(ROWBYTES);
    int subarray = is(SUBARRAYMODE, 2), binning = (int)fake.props[BINNING].value;
    int row0 = subarray ? (int)fake.props[VPOS].value : 0, col0 = subarray ? (int)fake.props[HPOS].value : 0;
    int stamp = fake.flying[0].stamp;
    for (int r = 0; r < rows; r++) {
        uint8_t *row = fake.ring[slot] + (size_t)r * (size_t)stride;
        memset(row, 0xEE, (size_t)stride);
        for (int c = 0; c < cols; c++) {
            unsigned v = ((unsigned)stamp & 15u) << 12 | ((unsigned)(row0 + r * binning) & 63u) << 6 | ((unsigned)(col0 + c * binning) & 63u);
            row[2 * c] = (uint8_t)(v & 255u);
            row[2 * c + 1] = (uint8_t)(v >> 8);
        }
    }
    fake.stamps[slot] = fake.faults[NO_STAMPS] ? 0 : stamp;
    fake.times[slot] = fake.flying[0].begin - fake.boot; /* the camera's clock starts when it is switched on */
    memmove(fake.flying, fake.flying + 1, sizeof fake.flying - sizeof *fake.flying);
    fake.n_flying--;
    fake.count++;
    if (fake.faults[SWALLOW] > 0) fake.faults[SWALLOW]--;
    else fake.pending |= EV_FRAMEREADY;
    if (fake.mode == 0 && fake.count == fake.slots) { fake.status = ST_READY; fake.pending |= EV_STOPPED; }
    pthread_cond_broadcast(&changed);
}

static void expose(double begin, double exposure) {
    int stamp = fake.faults[FIRST_STAMP] + (fake.faults[STAMPS_GO_ON] ? fake.life : fake.exposed);
    fake.exposed++; fake.life++;
    if (is(TRIGGERSOURCE, 2)) {
        int number = fake.externals++;
        if (fake.faults[UNPLUG_AT] && number >= fake.faults[UNPLUG_AT]) fake.faults[UNPLUGGED] = 1;
        if (number < (int)sizeof fake.lost && fake.lost[number]) return;
    }
    if (fake.faults[DROP] > 0) { fake.faults[DROP]--; return; }
    if (fake.n_flying == 4) deliver();
    fake.flying[fake.n_flying].begin = begin;
    fake.flying[fake.n_flying].ready = begin + exposure + get(READOUTTIME);
    fake.flying[fake.n_flying++].stamp = stamp;
}

static double next_pulse(void) { /* a rising edge on the trigger input */
    if (!fake.cable) return fake.seen < fake.n_pulses ? fake.pulses[fake.seen] : INFINITY;
    double time = fake.cable(fake.looked);
    return time < 0 ? INFINITY : time;
}

static double free_run(void) {
    if (!capturing() || !is(TRIGGERSOURCE, 1) || (fake.mode == 0 && fake.exposed >= fake.slots)) return INFINITY;
    return fake.started + fake.exposed * get(FRAMEINTERVAL);
}

static void external_edge(double edge) {
    if (!capturing() || !is(TRIGGERSOURCE, 2)) return;
    if (++fake.edges % (int)fake.props[TRIGGERTIMES].value) return;
    if (edge - fake.last_edge < get(MININTERVAL) - 1e-6) return; /* too early: ignored without a word */
    double begin = edge + fake.props[TRIGGERDELAY].value;
    fake.last_edge = edge;
    if (is(TRIGGER_MODE, 6)) { /* START: runs freely from here on, and forgets where the start came from */
        fake.props[TRIGGERSOURCE].value = 1;
        fake.started = begin;
    } else if (is(TRIGGERACTIVE, 3)) { /* SYNCREADOUT: each pulse ends one exposure and begins the next */
        if (fake.open_edge > LONG_AGO) expose(fake.open_edge, begin - fake.open_edge);
        fake.open_edge = begin;
    } else expose(begin, is(TRIGGERACTIVE, 2) ? PULSE_WIDTH : get(EXPOSURETIME));
}

static double next_event(void) { /* in the camera or on its cable; what lies before now has happened */
    double event = fmin(free_run(), fake.n_flying ? fake.flying[0].ready : INFINITY);
    return fmin(event, next_pulse() + (is(TRIGGERPOLARITY, 2) ? 0 : PULSE_WIDTH));
}

static void catch_up(void) {
    for (;;) {
        double pulse = next_pulse(), edge = pulse + (is(TRIGGERPOLARITY, 2) ? 0 : PULSE_WIDTH), run = free_run();
        double ready = fake.n_flying ? fake.flying[0].ready : INFINITY, first = fmin(ready, fmin(edge, run));
        if (first > now()) return;
        if (ready <= first) deliver();
        else if (run <= first) { fake.last_edge = run; expose(run, get(EXPOSURETIME)); }
        else { fake.seen++; fake.looked = pulse; external_edge(edge); }
    }
}

static int supported_events(void) { return EV_FRAMEREADY | (fake.faults[NO_STOPPED_EVENT] ? 0 : EV_STOPPED); }

static void release(void) {
    for (int i = 0; i < fake.slots; i++) free(fake.ring[i]);
    free(fake.ring); free(fake.stamps); free(fake.times);
    fake.ring = NULL; fake.stamps = NULL; fake.times = NULL; fake.slots = fake.n_flying = 0;
    fake.status = ST_STABLE;
}

static void stop(void) {
    if (fake.status != ST_BUSY) return;
    fake.status = ST_READY;
    fake.n_flying = 0;
    fake.pending |= EV_STOPPED & supported_events();
    pthread_cond_broadcast(&changed);
}

static int find(int32_t id) {
    for (int p = 0; p < N_PROPS; p++) if (TABLE[p].id == id && fake.faults[UNSUPPORTED] != id) return p;
    return -1;
}
