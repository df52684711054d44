/* Preloaded into a program (LD_PRELOAD): counts what it writes to files whose path contains a text, and kills it or
   lets the writes fail from a number on. See faulty_disk.py. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static const char *pattern;
static long kill_at, fail_from, fail_at, torn;
static int number;
static long own, *count = &own; /* shared with the processes that this one starts */

static long setting(const char *name) {
    const char *said = getenv(name);
    return said ? atol(said) : 0;
}

/* Callable from a program that was forked: begin to count anew, with other settings. */
void faulty_disk_arm(long kill, long from, long at, int error, int half) {
    __atomic_store_n(count, 0, __ATOMIC_SEQ_CST);
    kill_at = kill, fail_from = from, fail_at = at, number = error, torn = half;
}

long faulty_disk_count(void) { return __atomic_load_n(count, __ATOMIC_SEQ_CST); }

__attribute__((constructor)) static void begin(void) {
    const char *path = getenv("FAULTY_DISK_COUNT");
    int file = path ? open(path, O_RDWR) : -1;
    if (file >= 0) {
        void *shared = mmap(NULL, sizeof(long), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
        if (shared != MAP_FAILED) count = shared;
        close(file);
    }
    kill_at = setting("FAULTY_DISK_KILL_AT"), fail_from = setting("FAULTY_DISK_FAIL_FROM");
    fail_at = setting("FAULTY_DISK_FAIL_AT"), number = (int)setting("FAULTY_DISK_ERRNO");
    torn = setting("FAULTY_DISK_TORN"), pattern = getenv("FAULTY_DISK_PATTERN");
}

static int named(const char *path) { return pattern && path && strstr(path, pattern) != NULL; }

static int watched(int file) {
    char link[64], path[PATH_MAX + 1];
    if (!pattern) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t n = readlink(link, path, PATH_MAX);
    if (n < 0) return 0;
    path[n] = 0;
    return named(path);
}

enum fate { GO, FAIL, DIE };

/* What becomes of the next write. */
static enum fate next(void) {
    long n = __atomic_add_fetch(count, 1, __ATOMIC_SEQ_CST);
    if (kill_at && n == kill_at) return DIE;
    return (fail_at && n == fail_at) || (fail_from && n >= fail_from) ? FAIL : GO;
}

static int first_to_fail(void) {
    long n = faulty_disk_count();
    return n == fail_at || n == fail_from;
}

static void die(void) {
    kill(getpid(), SIGKILL);
    for (;;) pause();
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
/* `half` writes the first half of what was asked for, as a disk that fills up and a machine that loses power may. */
#define OUTCOME(half, failed)                                  \
    switch (next()) {                                          \
        case DIE: if (torn) { half; } die(); /* fall through */ \
        case FAIL: if (torn && first_to_fail()) { half; } errno = number; return failed; \
        case GO: break;                                        \
    }

ssize_t write(int f, const void *b, size_t n) {
    if (watched(f)) OUTCOME((void)!REAL(write)(f, b, n / 2), -1)
    return REAL(write)(f, b, n);
}
ssize_t pwrite(int f, const void *b, size_t n, off_t at) {
    if (watched(f)) OUTCOME((void)!REAL(pwrite)(f, b, n / 2, at), -1)
    return REAL(pwrite)(f, b, n, at);
}
ssize_t pwrite64(int f, const void *b, size_t n, off64_t at) {
    if (watched(f)) OUTCOME((void)!REAL(pwrite64)(f, b, n / 2, at), -1)
    return REAL(pwrite64)(f, b, n, at);
}
ssize_t writev(int f, const struct iovec *b, int n) {
    if (watched(f)) OUTCOME((void)!REAL(writev)(f, b, n / 2), -1)
    return REAL(writev)(f, b, n);
}
ssize_t pwritev(int f, const struct iovec *b, int n, off_t at) {
    if (watched(f)) OUTCOME((void)!REAL(pwritev)(f, b, n / 2, at), -1)
    return REAL(pwritev)(f, b, n, at);
}
ssize_t pwritev64(int f, const struct iovec *b, int n, off64_t at) {
    if (watched(f)) OUTCOME((void)!REAL(pwritev64)(f, b, n / 2, at), -1)
    return REAL(pwritev64)(f, b, n, at);
}
/* ndarray.tofile; flushed at once, so that what is counted here is what reaches the file here */
size_t fwrite(const void *b, size_t size, size_t n, FILE *stream) {
    if (!watched(fileno(stream))) return REAL(fwrite)(b, size, n, stream);
    OUTCOME((REAL(fwrite)(b, size, n / 2, stream), fflush(stream)), 0)
    size_t done = REAL(fwrite)(b, size, n, stream);
    fflush(stream);
    return done;
}
ssize_t sendfile(int out, int in, off_t *at, size_t n) {
    if (watched(out)) OUTCOME((void)0, -1)
    return ((ssize_t(*)(int, int, off_t *, size_t))dlsym(RTLD_NEXT, "sendfile"))(out, in, at, n);
}
ssize_t sendfile64(int out, int in, off64_t *at, size_t n) {
    if (watched(out)) OUTCOME((void)0, -1)
    return ((ssize_t(*)(int, int, off64_t *, size_t))dlsym(RTLD_NEXT, "sendfile64"))(out, in, at, n);
}
ssize_t copy_file_range(int in, off64_t *a, int out, off64_t *b, size_t n, unsigned flags) {
    if (watched(out)) OUTCOME((void)0, -1)
    return REAL(copy_file_range)(in, a, out, b, n, flags);
}
int ftruncate(int f, off_t n) {
    if (watched(f)) OUTCOME((void)0, -1)
    return REAL(ftruncate)(f, n);
}
int ftruncate64(int f, off64_t n) {
    if (watched(f)) OUTCOME((void)0, -1)
    return REAL(ftruncate64)(f, n);
}
/* These two give the error itself back. */
int posix_fallocate(int f, off_t at, off_t n) {
    if (watched(f)) OUTCOME((void)0, number)
    return REAL(posix_fallocate)(f, at, n);
}
int posix_fallocate64(int f, off64_t at, off64_t n) {
    if (watched(f)) OUTCOME((void)0, number)
    return REAL(posix_fallocate64)(f, at, n);
}
int fsync(int f) {
    if (watched(f)) OUTCOME((void)0, -1)
    return REAL(fsync)(f);
}
int fdatasync(int f) {
    if (watched(f)) OUTCOME((void)0, -1)
    return REAL(fdatasync)(f);
}
/* numpy.memmap.flush; the pages themselves are not seen on their way */
int msync(void *begin, size_t n, int flags) {
    char line[PATH_MAX + 100];
    unsigned long first, end;
    FILE *maps = pattern ? fopen("/proc/self/maps", "r") : NULL;
    int here = 0;
    while (maps && !here && fgets(line, sizeof line, maps))
        here = sscanf(line, "%lx-%lx", &first, &end) == 2 && (unsigned long)begin >= first &&
               (unsigned long)begin < end && named(line);
    if (maps) fclose(maps);
    if (here) OUTCOME((void)0, -1)
    return REAL(msync)(begin, n, flags);
}
int rename(const char *from, const char *to) {
    if (named(from) || named(to)) OUTCOME((void)0, -1)
    return REAL(rename)(from, to);
}
/* A full disk lets files be removed, so these are counted and kill, and never fail. */
int unlink(const char *path) {
    if (named(path) && next() == DIE) die();
    return REAL(unlink)(path);
}
int rmdir(const char *path) {
    if (named(path) && next() == DIE) die();
    return REAL(rmdir)(path);
}
