/* Preloaded into a program (LD_PRELOAD): in the folder CASELESS_FOLDER a name stands for the file whose name differs
   from it in case alone, as on Windows and macOS. See test_windows.py. */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>
#include <unistd.h>

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

/* Replaces the name at the end of `path` by the one that the folder before it lists. */
static void as_listed(char *path) {
    struct stat found;
    char *name = strrchr(path, '/') + 1;
    if (!*name || !REAL(lstat)(path, &found)) return;
    name[-1] = 0;
    DIR *folder = REAL(opendir)(path);
    name[-1] = '/';
    for (struct dirent *entry; folder && (entry = readdir(folder));)
        if (!strcasecmp(entry->d_name, name)) strcpy(name, entry->d_name);
    if (folder) closedir(folder);
}

/* The path with the names that exist; `path` itself outside the folder. */
static const char *resolved(int at, const char *path, char *made) {
    const char *top = getenv("CASELESS_FOLDER");
    char given[2 * PATH_MAX] = "", link[64];
    if (!path || !*path || !top) return path;
    if (*path != '/') {
        snprintf(link, sizeof link, at == AT_FDCWD ? "/proc/self/cwd" : "/proc/self/fd/%d", at);
        if (REAL(readlink)(link, given, PATH_MAX) < 0) return path;
        strcat(given, "/");
    }
    strncat(given, path, PATH_MAX);
    size_t n = strlen(top);
    if (strncmp(given, top, n) || given[n] != '/') return path;
    strcpy(made, top);
    for (char *rest, *name = strtok_r(given + n, "/", &rest); name; name = strtok_r(NULL, "/", &rest)) {
        if (strlen(made) + strlen(name) + 2 > PATH_MAX) return path;
        strcat(strcat(made, "/"), name);
        as_listed(made);
    }
    return made;
}

#define PATHS char first[PATH_MAX + 1], second[PATH_MAX + 1]; (void)second;
#define ONE(path) resolved(AT_FDCWD, path, first)
#define MODE mode_t mode = 0; \
    if (flags & (O_CREAT | O_TMPFILE)) { va_list more; va_start(more, flags); mode = va_arg(more, mode_t); va_end(more); }

int open(const char *p, int flags, ...) { PATHS MODE return REAL(open)(ONE(p), flags, mode); }
int open64(const char *p, int flags, ...) { PATHS MODE return REAL(open64)(ONE(p), flags, mode); }
int openat(int at, const char *p, int flags, ...) {
    PATHS MODE return REAL(openat)(at, resolved(at, p, first), flags, mode);
}
int openat64(int at, const char *p, int flags, ...) {
    PATHS MODE return REAL(openat64)(at, resolved(at, p, first), flags, mode);
}
FILE *fopen(const char *p, const char *how) { PATHS return REAL(fopen)(ONE(p), how); }
FILE *fopen64(const char *p, const char *how) { PATHS return REAL(fopen64)(ONE(p), how); }
int stat(const char *p, struct stat *s) { PATHS return REAL(stat)(ONE(p), s); }
int stat64(const char *p, struct stat64 *s) { PATHS return REAL(stat64)(ONE(p), s); }
int lstat(const char *p, struct stat *s) { PATHS return REAL(lstat)(ONE(p), s); }
int lstat64(const char *p, struct stat64 *s) { PATHS return REAL(lstat64)(ONE(p), s); }
int fstatat(int at, const char *p, struct stat *s, int f) { PATHS return REAL(fstatat)(at, resolved(at, p, first), s, f); }
int fstatat64(int at, const char *p, struct stat64 *s, int f) {
    PATHS return REAL(fstatat64)(at, resolved(at, p, first), s, f);
}
/* The names of stat in programs that were built with an older glibc */
#define OLDER(name, of) \
    int name(int v, const char *p, struct of *s) { \
        PATHS return ((int (*)(int, const char *, struct of *))dlsym(RTLD_NEXT, #name))(v, ONE(p), s); \
    }
OLDER(__xstat, stat) OLDER(__xstat64, stat64) OLDER(__lxstat, stat) OLDER(__lxstat64, stat64)
int access(const char *p, int mode) { PATHS return REAL(access)(ONE(p), mode); }
int faccessat(int at, const char *p, int mode, int f) { PATHS return REAL(faccessat)(at, resolved(at, p, first), mode, f); }
int mkdir(const char *p, mode_t mode) { PATHS return REAL(mkdir)(ONE(p), mode); }
int mkdirat(int at, const char *p, mode_t mode) { PATHS return REAL(mkdirat)(at, resolved(at, p, first), mode); }
int rmdir(const char *p) { PATHS return REAL(rmdir)(ONE(p)); }
int unlink(const char *p) { PATHS return REAL(unlink)(ONE(p)); }
int unlinkat(int at, const char *p, int f) { PATHS return REAL(unlinkat)(at, resolved(at, p, first), f); }
int chmod(const char *p, mode_t mode) { PATHS return REAL(chmod)(ONE(p), mode); }
int chdir(const char *p) { PATHS return REAL(chdir)(ONE(p)); }
DIR *opendir(const char *p) { PATHS return REAL(opendir)(ONE(p)); }
ssize_t readlink(const char *p, char *b, size_t n) { PATHS return REAL(readlink)(ONE(p), b, n); }
int symlink(const char *to, const char *p) { PATHS return REAL(symlink)(to, ONE(p)); }
int rename(const char *p, const char *to) {
    PATHS return REAL(rename)(ONE(p), resolved(AT_FDCWD, to, second));
}
int link(const char *p, const char *to) { PATHS return REAL(link)(ONE(p), resolved(AT_FDCWD, to, second)); }
int linkat(int at, const char *p, int there, const char *to, int f) {
    PATHS return REAL(linkat)(at, resolved(at, p, first), there, resolved(there, to, second), f);
}
