/* Calls of the system that fail once, or at which the process is killed: loaded before libc (LD_PRELOAD).
 *
 * Counted are calls that concern what lies below some folders. `faults_arm` says which is to go wrong, and how.
 * A write that goes wrong has written half of its bytes by then.
 */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

enum { MAX_FOLDERS = 4, MAX_FILES = 4096 };

static char folders[MAX_FOLDERS][4096];
static int folder_count = 0;
static long chosen = -1;
static int kills = 0;
static int journal = -1;
static atomic_long calls;
static char watched[MAX_FILES];

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

/* Below `below` (absolute folders, a line each) the call number `at`, counted from 0, fails or, with `to_kill`,
 * kills the process. Calls are listed in the file `log`. */
void faults_arm(const char *below, long at, int to_kill, const char *log)
{
    journal = (int)syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_CREAT | O_TRUNC | O_APPEND | O_CLOEXEC, 0600);
    folder_count = 0;
    for (const char *start = below; *start && folder_count < MAX_FOLDERS;) {
        size_t length = strcspn(start, "\n");
        snprintf(folders[folder_count++], sizeof folders[0], "%.*s", (int)length, start);
        start += length + (start[length] == '\n');
    }
    chosen = at;
    kills = to_kill;
    atomic_store(&calls, 0);
}

static int is_below(int at, const char *path)
{
    char whole[8192];
    if (path[0] == '/') {
        snprintf(whole, sizeof whole, "%s", path);
    } else {
        char link[64];
        if (at == AT_FDCWD)
            snprintf(link, sizeof link, "/proc/self/cwd");
        else
            snprintf(link, sizeof link, "/proc/self/fd/%d", at);
        ssize_t length = readlink(link, whole, 4096);
        if (length < 0)
            return 0;
        snprintf(whole + length, sizeof whole - (size_t)length, "/%s", path);
    }
    for (int i = 0; i < folder_count; i++) {
        size_t length = strlen(folders[i]);
        if (!strncmp(whole, folders[i], length) && (whole[length] == '/' || !whole[length]))
            return 1;
    }
    return 0;
}

/* Whether this call is the one. */
static int is_due(const char *call, const char *path)
{
    char line[8192];
    long number = atomic_fetch_add(&calls, 1);
    int length = snprintf(line, sizeof line, "%s %s\n", call, path);
    if (journal >= 0)
        syscall(SYS_write, journal, line, (size_t)length);
    return number == chosen;
}

static int fails(const char *call, int at, const char *path, int reason)
{
    if (!folder_count || !is_below(at, path) || !is_due(call, path))
        return 0;
    if (kills)
        syscall(SYS_kill, getpid(), SIGKILL);
    errno = reason;
    return 1;
}

static int is_watched(int file)
{
    return folder_count && file >= 0 && file < MAX_FILES && watched[file];
}

static int opened(int file, int at, const char *path)
{
    if (file >= 0 && file < MAX_FILES)
        watched[file] = (char)(folder_count && is_below(at, path));
    return file;
}

#define OPEN(name, at, ...)                                                                                   \
    {                                                                                                         \
        mode_t mode = 0;                                                                                      \
        if (flags & O_CREAT) {                                                                                \
            va_list rest;                                                                                     \
            va_start(rest, flags);                                                                            \
            mode = va_arg(rest, mode_t);                                                                      \
            va_end(rest);                                                                                     \
        }                                                                                                     \
        if (fails(flags & O_CREAT ? "create" : "open", at, path, flags & O_CREAT ? ENOSPC : EIO))              \
            return -1;                                                                                        \
        return opened(REAL(name)(__VA_ARGS__, flags, mode), at, path);                                        \
    }

int open(const char *path, int flags, ...) OPEN(open, AT_FDCWD, path)
int open64(const char *path, int flags, ...) OPEN(open64, AT_FDCWD, path)
int openat(int at, const char *path, int flags, ...) OPEN(openat, at, at, path)
int openat64(int at, const char *path, int flags, ...) OPEN(openat64, at, at, path)

int close(int file)
{
    if (file >= 0 && file < MAX_FILES)
        watched[file] = 0;
    return REAL(close)(file);
}

ssize_t read(int file, void *buffer, size_t size)
{
    if (is_watched(file) && is_due("read", "")) {
        if (kills)
            syscall(SYS_kill, getpid(), SIGKILL);
        errno = EIO;
        return -1;
    }
    return REAL(read)(file, buffer, size);
}

ssize_t write(int file, const void *buffer, size_t size)
{
    if (is_watched(file) && is_due("write", "")) {
        REAL(write)(file, buffer, size / 2);
        if (kills)
            syscall(SYS_kill, getpid(), SIGKILL);
        errno = ENOSPC;
        return -1;
    }
    return REAL(write)(file, buffer, size);
}

int fsync(int file)
{
    if (is_watched(file) && is_due("fsync", "")) {
        if (kills)
            syscall(SYS_kill, getpid(), SIGKILL);
        errno = EIO;
        return -1;
    }
    return REAL(fsync)(file);
}

int rename(const char *from, const char *to)
{
    return fails("rename", AT_FDCWD, to, EIO) ? -1 : REAL(rename)(from, to);
}

int renameat(int at, const char *from, int there, const char *to)
{
    return fails("rename", there, to, EIO) ? -1 : REAL(renameat)(at, from, there, to);
}

int renameat2(int at, const char *from, int there, const char *to, unsigned flags)
{
    return fails("exchange", there, to, EIO) ? -1 : REAL(renameat2)(at, from, there, to, flags);
}

int unlink(const char *path)
{
    return fails("unlink", AT_FDCWD, path, EIO) ? -1 : REAL(unlink)(path);
}

int unlinkat(int at, const char *path, int flags)
{
    return fails("unlink", at, path, EIO) ? -1 : REAL(unlinkat)(at, path, flags);
}

int rmdir(const char *path)
{
    return fails("rmdir", AT_FDCWD, path, EIO) ? -1 : REAL(rmdir)(path);
}

int mkdir(const char *path, mode_t mode)
{
    return fails("mkdir", AT_FDCWD, path, ENOSPC) ? -1 : REAL(mkdir)(path, mode);
}

int mkdirat(int at, const char *path, mode_t mode)
{
    return fails("mkdir", at, path, ENOSPC) ? -1 : REAL(mkdirat)(at, path, mode);
}

DIR *opendir(const char *path)
{
    return fails("list", AT_FDCWD, path, EIO) ? NULL : REAL(opendir)(path);
}
