// One datagram to the socket that NOTIFY_SOCKET names. sd_notify(3) declares the protocol stable and
// free to be implemented; libsystemd, for these few lines, would load a compression and a
// cryptography library into every daemon.
#include "server/notify.h"

#include <errno.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include "server/log.h"

void notify_send(const char *state) {
    const char *path = getenv("NOTIFY_SOCKET");
    if (path == NULL || *path == '\0')
        return;
    struct sockaddr_un to = {.sun_family = AF_UNIX};
    const size_t n = strlen(path);
    if ((path[0] != '/' && path[0] != '@') || n >= sizeof to.sun_path) {
        log_warn("notify", "error=\"NOTIFY_SOCKET must be a path or @name of at most %zu characters\"",
                 sizeof to.sun_path - 1);
        return;
    }
    memcpy(to.sun_path, path, n);
    if (to.sun_path[0] == '@') // a name in the abstract namespace
        to.sun_path[0] = '\0';
    const int fd = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    const socklen_t length = (socklen_t)(offsetof(struct sockaddr_un, sun_path) + n);
    if (fd < 0 || sendto(fd, state, strlen(state), MSG_NOSIGNAL, (const struct sockaddr *)&to,
                         length) < 0)
        log_warn("notify", "socket=\"%s\" error=\"%s\"", path, strerror(errno));
    if (fd >= 0)
        close(fd);
}
