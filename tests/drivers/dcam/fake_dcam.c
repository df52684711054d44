/* Stand-in for the DCAM-API v4 library with one ORCA-Quest behind it, for tests of the ctypes driver: the calls. */
#define _GNU_SOURCE
#include "dcam_types.h"
#include "fake_camera.h"
#include "fake_world.h"

static int32_t leave(int32_t code) { pthread_mutex_unlock(&lock); return code; }
#define CALL() do { pthread_mutex_lock(&lock); int32_t failure = called(__func__); if (failure) return leave(failure); } while (0)
#define ENTER() do { CALL(); \
    if (!fake.session) return leave(UNLOADED); \
    catch_up(); \
    if (fake.faults[UNPLUGGED]) return leave(NOCONNECTION); } while (0)
#define CAMERA(h) do { ENTER(); if (!(h) || (h) != fake.camera) return leave(INVALIDHANDLE); } while (0)
#define SIZED(p, field) do { if (!(p) || (p)->field != (int32_t)sizeof *(p)) return leave(INVALIDPARAM); } while (0)

static void *new_handle(void) {
    if (fake.n_handles == MAX_HANDLES) abort();
    return &handles[fake.n_handles++];
}

int32_t dcamapi_init(DCAMAPI_INIT *p) {
    pthread_mutex_lock(&lock);
    int32_t failure = called(__func__);
    if (!p || p->size != (int32_t)sizeof *p || p->initoptionbytes != 0 || p->initoption) return leave(INVALIDPARAM);
    if (fake.session) return leave(BUSY); /* one session a process */
    fake.session = 1;                     /* also where it fails: it must be ended then too */
    if (failure) return leave(failure);
    if (fake.faults[NO_CAMERA] || fake.faults[UNPLUGGED]) return leave(NOCAMERA);
    p->iDeviceCount = fake.devices;
    return leave(SUCCESS);
}

int32_t dcamapi_uninit(void) {
    CALL();
    if (fake.slots) release();
    fake.session = 0; fake.camera = fake.wait = NULL;
    return leave(SUCCESS);
}

int32_t dcamdev_open(DCAMDEV_OPEN *p) {
    ENTER(); SIZED(p, size);
    if (p->index < 0 || p->index >= fake.devices) return leave(INVALIDCAMERA);
    p->hdcam = fake.camera = new_handle();
    return leave(SUCCESS);
}

int32_t dcamdev_close(void *h) {
    CAMERA(h);
    if (fake.slots) release();
    fake.camera = fake.wait = NULL;
    return leave(SUCCESS);
}

int32_t dcamdev_getcapability(void *h, DCAMDEV_CAPABILITY *p) {
    CAMERA(h); SIZED(p, size);
    if (p->domain != 0 || p->kind != 0) return leave(NOTSUPPORT);
    p->capflag = fake.faults[NO_STAMPS] ? 0 : 3; /* framestamps, timestamps */
    return leave(SUCCESS);
}

int32_t dcamdev_getstring(void *h, DCAMDEV_STRING *p) {
    ENTER(); SIZED(p, size);
    if (h != fake.camera && (intptr_t)h >= fake.devices) return leave(INVALIDHANDLE);
    static const char *const texts[] = {"USB3", "S/N: 000123", "Hamamatsu", "C15550-20UP", "2.20.A", "21.1", "21.2", "4.10"};
    int32_t i = p->iString - 0x04000101;
    if (i < 0 || i > 7 || p->iString == fake.faults[UNSUPPORTED]) return leave(NOTSUPPORT);
    snprintf(p->text, (size_t)p->textbytes, "%s", texts[i]);
    return leave(SUCCESS);
}

int32_t dcamprop_getattr(void *h, DCAMPROP_ATTR *a) {
    CAMERA(h); SIZED(a, cbSize);
    int p = find(a->iProp);
    if (p < 0) return leave(NOTSUPPORT);
    const Property *q = &fake.props[p];
    int ranged = q->max > q->min;
    a->attribute = (int32_t)((ranged ? 0xC0000000u : 0u) | 0x10000u | (uint32_t)q->access | (uint32_t)q->type);
    a->iUnit = p == TEMPERATURE ? 2 : (q->type & 15) == REAL; /* Celsius, second */
    a->valuemin = p == EXPOSURETIME && slow() ? 172.8e-6 : q->min;
    a->valuemax = highest(p); a->valuestep = q->step; a->valuedefault = q->initial;
    return leave(SUCCESS);
}

int32_t dcamprop_getvalue(void *h, int32_t id, double *value) {
    CAMERA(h);
    int p = find(id);
    if (p < 0) return leave(NOTSUPPORT);
    *value = get(p);
    return leave(SUCCESS);
}

int32_t dcamprop_setvalue(void *h, int32_t id, double value) {
    CAMERA(h);
    int p = find(id);
    if (p < 0) return leave(NOTSUPPORT);
    Property *q = &fake.props[p];
    if (q->access == RO || (p == READOUTSPEED && counts_photons())) return leave(NOTWRITABLE);
    if (fake.status == ST_READY && !(q->access & 0x2000)) return leave(NOTSTABLE);
    if (fake.status == ST_BUSY && !(q->access & 0x1000)) return leave(BUSY);
    if (fake.faults[REFUSE] == id) return leave(INVALIDVALUE);
    if ((q->type & 15) == MODE) {
        int legal = 0;
        for (int i = 0; i < 4; i++) legal |= q->legal[i] && q->legal[i] == value;
        if (!legal || (p == DEFECT && value == 2 && counts_photons())) return leave(INVALIDVALUE);
    } else {
        double min = p == EXPOSURETIME && slow() ? 172.8e-6 : q->min;
        if (!(q->type & ROUNDS) && (value < min || value > highest(p))) return leave(OUTOFRANGE);
        if (q->type & ROUNDS) value = fmin(fmax(ceil(value / q->step - 1e-6) * q->step, min), highest(p));
    }
    double before = q->value;
    q->value = value;
    if (fake.props[SUBARRAYMODE].value == 2 && (fake.props[HPOS].value + fake.props[HSIZE].value > fake.sensor_cols ||
                                                fake.props[VPOS].value + fake.props[VSIZE].value > fake.sensor_rows)) {
        q->value = before;
        return leave(INVALIDSUBARRAY);
    }
    if (slow()) fake.props[EXPOSURETIME].value = fmax(fake.props[EXPOSURETIME].value, 172.8e-6);
    return leave(SUCCESS);
}

int32_t dcamprop_queryvalue(void *h, int32_t id, double *value, int32_t option) {
    CAMERA(h);
    int p = find(id);
    if (p < 0) return leave(NOTSUPPORT);
    if (option != 0x01000000 || (fake.props[p].type & 15) != MODE) return leave(INVALIDPARAM);
    for (int i = 0; i < 4; i++) {
        if (fake.props[p].legal[i] > *value) { *value = fake.props[p].legal[i]; return leave(SUCCESS); }
    }
    return leave(OUTOFRANGE);
}

int32_t dcambuf_alloc(void *h, int32_t n) {
    CAMERA(h);
    if (fake.status != ST_STABLE) return leave(BUSY);
    if (n < 1) return leave(INVALIDPARAM);
    if (fake.faults[NO_MEMORY]) return leave(NOMEMORY);
    fake.ring = calloc((size_t)n, sizeof *fake.ring);
    fake.stamps = calloc((size_t)n, sizeof *fake.stamps);
    fake.times = calloc((size_t)n, sizeof *fake.times);
    for (int i = 0; i < n; i++) fake.ring[i] = malloc((size_t)get(FRAMEBYTES) - (fake.faults[SHORT_RING] ? 1 : 0));
    fake.slots = n; fake.count = 0; fake.status = ST_READY;
    return leave(SUCCESS);
}

int32_t dcambuf_release(void *h, int32_t kind) {
    CAMERA(h);
    if (kind != 0) return leave(INVALIDPARAM);
    if (fake.status == ST_BUSY) return leave(BUSY);
    if (fake.slots) release();
    return leave(SUCCESS);
}

int32_t dcambuf_lockframe(void *h, DCAMBUF_FRAME *f) {
    CAMERA(h); SIZED(f, size);
    if (f->iKind || f->option) return leave(INVALIDPARAM);
    if (!fake.slots) return leave(NOTREADY);
    int slot = f->iFrame == -1 ? (fake.count - 1) % fake.slots : f->iFrame;
    if (slot < 0 || slot >= fake.slots) return leave(INVALIDFRAMEINDEX);
    if (slot >= fake.count) return leave(BUSY);
    f->buf = fake.ring[slot]; f->rowbytes = (int32_t)get(ROWBYTES); f->type = 2;
    f->width = (int32_t)get(WIDTH); f->height = (int32_t)get(HEIGHT); f->left = f->top = 0;
    f->timestamp.sec = (uint32_t)floor(fake.times[slot]);
    f->timestamp.microsec = (int32_t)lround((fake.times[slot] - floor(fake.times[slot])) * 1e6);
    f->framestamp = fake.stamps[slot]; f->camerastamp = 0;
    for (; fake.faults[OVERRUN_IN_LOCK] > 0; fake.faults[OVERRUN_IN_LOCK]--) {
        fake.last_edge += get(MININTERVAL);
        expose(fake.last_edge, get(EXPOSURETIME));
        if (fake.n_flying) deliver(); /* it may have been lost on its way */
    }
    return leave(SUCCESS);
}

int32_t dcamcap_start(void *h, int32_t mode) {
    CAMERA(h);
    if (mode != -1 && mode != 0) return leave(INVALIDPARAM);
    if (fake.status != ST_READY) return leave(fake.status == ST_BUSY ? BUSY : NOTREADY);
    fake.status = ST_BUSY; fake.mode = mode; fake.polls = 0;
    fake.count = fake.exposed = fake.edges = fake.pending = 0;
    fake.started = now(); fake.last_edge = fake.open_edge = LONG_AGO;
    return leave(SUCCESS);
}

int32_t dcamcap_stop(void *h) {
    CAMERA(h);
    if (fake.status != ST_BUSY) return leave(NONE);
    stop();
    return leave(SUCCESS);
}

int32_t dcamcap_status(void *h, int32_t *status) {
    CAMERA(h);
    if (fake.faults[ODD_STATUS]) *status = fake.faults[ODD_STATUS];
    else *status = fake.status == ST_BUSY && fake.polls++ < fake.faults[START_POLLS] ? ST_READY : fake.status;
    return leave(SUCCESS);
}

int32_t dcamcap_transferinfo(void *h, DCAMCAP_TRANSFERINFO *p) {
    CAMERA(h); SIZED(p, size);
    if (!fake.slots) return leave(NOTREADY);
    p->nFrameCount = fake.count - fake.faults[COUNT_BACK];
    p->nNewestFrameIndex = fake.count ? (fake.count - 1) % fake.slots : -1;
    return leave(SUCCESS);
}

int32_t dcamcap_firetrigger(void *h, int32_t kind) {
    CAMERA(h);
    if (kind != 0) return leave(INVALIDPARAM);
    if (!capturing() || !is(TRIGGERSOURCE, 3)) return leave(NOTREADY);
    double edge = fmax(now(), fake.last_edge + get(MININTERVAL)); /* it waits until the camera can take it */
    if (fake.virtual_now > 0) fake.virtual_now = edge;
    catch_up();
    fake.last_edge = edge;
    expose(edge, get(EXPOSURETIME));
    return leave(SUCCESS);
}

int32_t dcamwait_open(DCAMWAIT_OPEN *p) {
    ENTER(); SIZED(p, size);
    if (!p->hdcam || p->hdcam != fake.camera) return leave(INVALIDHANDLE);
    p->hwait = fake.wait = new_handle();
    p->supportevent = supported_events();
    return leave(SUCCESS);
}

#define WAIT(w) do { ENTER(); if (!(w) || (w) != fake.wait) return leave(INVALIDWAITHANDLE); } while (0)

int32_t dcamwait_close(void *w) {
    WAIT(w);
    if (fake.waiters) return leave(BUSY);
    fake.wait = NULL;
    return leave(SUCCESS);
}

int32_t dcamwait_abort(void *w) { /* nothing where nobody waits */
    WAIT(w);
    fake.aborts++;
    pthread_cond_broadcast(&changed);
    return leave(SUCCESS);
}

int32_t dcamwait_start(void *w, DCAMWAIT_START *p) {
    WAIT(w); SIZED(p, size);
    if (!p->eventmask || (p->eventmask & ~supported_events())) return leave(INVALIDPARAM);
    double deadline = now() + p->timeout / 1000.0;
    int32_t answer = 0;
    int aborts = fake.aborts;
    fake.waiters++;
    while (!answer) {
        catch_up();
        if (fake.faults[REPORT_LOSS] > 0) { fake.faults[REPORT_LOSS]--; answer = LOSTFRAME; break; }
        p->eventhappened = fake.pending & p->eventmask;
        fake.pending &= ~p->eventmask;
        if (fake.faults[UNPLUGGED]) answer = NOCONNECTION;
        else if (p->eventhappened) answer = SUCCESS;
        else if (fake.aborts != aborts) answer = ABORT;
        else if (now() >= deadline) answer = TIMEOUT;
        else {
            double until = fmin(deadline, next_event());
            struct timespec t = {(time_t)until, (long)((until - floor(until)) * 1e9)};
            if (fake.virtual_now > 0) fake.virtual_now = fmax(until, fake.virtual_now);
            else pthread_cond_timedwait(&changed, &lock, &t);
        }
    }
    for (int ms = answer == TIMEOUT ? 0 : fake.faults[SLOW_TO_WAKE]; ms > 0; ms--) { /* woken, but still in here */
        pthread_mutex_unlock(&lock);
        nanosleep(&(struct timespec){0, 1000000}, NULL);
        pthread_mutex_lock(&lock);
    }
    fake.waiters--;
    return leave(answer);
}
