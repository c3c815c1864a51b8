// fbar keygen: keys for an encrypted ZeroMQ socket, of a daemon and of those who may subscribe.
#include <cjson/cJSON.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/report.h"
#include "client/subscribe.h"
#include "client/terminal.h"

#define KEYGEN_PATH 4096
#define KEYGEN_NAME 64

// A new file of this mode that is on the disk when this returns; false, with the fault printed,
// also when there is one already.
static bool write_new(const char *path, mode_t mode, const char *text) {
    const int fd = open(path, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, mode);
    const size_t n = strlen(text);
    const bool written = fd >= 0 && write(fd, text, n) == (ssize_t)n && fsync(fd) == 0;
    if (!written)
        terminal_error("%s: %s", path, strerror(errno));
    if (fd >= 0)
        close(fd);
    return written;
}

static bool read_line(const char *path, char *out, size_t bytes) {
    FILE *file = fopen(path, "re");
    if (!file)
        return false;
    const bool read = fgets(out, (int)bytes, file) != NULL;
    fclose(file);
    out[strcspn(out, "\r\n")] = '\0';
    return read;
}

static bool make_folder(const char *path) {
    if (mkdir(path, 0700) == 0 || errno == EEXIST)
        return true;
    terminal_error("%s: %s", path, strerror(errno));
    return false;
}

// DIR/server.public and DIR/server.secret, made where they are missing; the public key.
static bool server_keys(const char *folder, char *public) {
    char path[KEYGEN_PATH], secret[SUBSCRIBE_KEY], text[SUBSCRIBE_KEY + 1];
    snprintf(path, sizeof path, "%s/server.public", folder);
    if (read_line(path, public, SUBSCRIBE_KEY + 1)) {
        if (strlen(public) == SUBSCRIBE_KEY - 1)
            return true;
        terminal_error("%s: must hold a key of %d characters", path, SUBSCRIBE_KEY - 1);
        return false;
    }
    if (subscribe_keypair(public, secret) != 0) {
        terminal_error("this libzmq was built without CURVE");
        return false;
    }
    snprintf(text, sizeof text, "%s\n", secret);
    snprintf(path, sizeof path, "%s/server.secret", folder);
    if (!write_new(path, 0600, text))
        return false;
    snprintf(text, sizeof text, "%s\n", public);
    snprintf(path, sizeof path, "%s/server.public", folder);
    return write_new(path, 0644, text);
}

static bool name_valid(const char *name) {
    const size_t n = strlen(name);
    return n > 0 && n <= KEYGEN_NAME && name[0] != '.' &&
           strspn(name, "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789._-") == n;
}

static int run(struct client *client, const struct arguments *arguments) {
    const char *folder = arguments->positionals[0];
    const char *name = arguments->n_positionals > 1 ? arguments->positionals[1] : "client";
    char path[KEYGEN_PATH], server[SUBSCRIBE_KEY + 1], public[SUBSCRIBE_KEY], secret[SUBSCRIBE_KEY];
    char text[4 * SUBSCRIBE_KEY + 200];
    if (!name_valid(name)) {
        terminal_error("NAME must be 1 to %d of A-Z a-z 0-9 . _ -, not beginning with a dot, got "
                       "\"%s\"",
                       KEYGEN_NAME, name);
        return CLIENT_USAGE;
    }
    if (strlen(folder) > KEYGEN_PATH - 128) {
        terminal_error("DIR is longer than %d characters", KEYGEN_PATH - 128);
        return CLIENT_USAGE;
    }
    snprintf(path, sizeof path, "%s/clients", folder);
    if (!make_folder(folder) || !make_folder(path) || !server_keys(folder, server))
        return CLIENT_IO;
    if (subscribe_keypair(public, secret) != 0) {
        terminal_error("this libzmq was built without CURVE");
        return CLIENT_IO;
    }
    // What the subscriber is given first: without it, an admitted key would be of no use.
    snprintf(text, sizeof text,
             "# For fbar --curve-file; keep it secret.\nserver %s\npublic %s\nsecret %s\n", server,
             public, secret);
    snprintf(path, sizeof path, "%s/%s.curve", folder, name);
    if (!write_new(path, 0600, text))
        return CLIENT_IO;
    snprintf(text, sizeof text, "%s\n", public);
    snprintf(path, sizeof path, "%s/clients/%s.public", folder, name);
    if (!write_new(path, 0644, text))
        return CLIENT_IO;
    snprintf(path, sizeof path, "%s/%s.curve", folder, name);
    if (client->json) {
        cJSON *answer = cJSON_CreateObject();
        cJSON_AddStringToObject(answer, "file", path);
        report_json(answer);
        cJSON_Delete(answer);
    } else {
        puts(path);
    }
    return CLIENT_DONE;
}

const struct command cmd_keygen = {
    .name = "keygen",
    .positionals = "DIR [NAME]",
    .summary = "make keys for `fbard --curve-dir DIR` and a subscriber",
    .doc =
        "The daemon's keys are made where DIR has none yet. NAME (default: client) may subscribe "
        "as\n"
        "long as DIR/clients/NAME.public is there; DIR/NAME.curve, whose path is printed, is for\n"
        "`fbar --curve-file` and is to be given to nobody else.",
    .least = 1,
    .most = 2,
    .run = run,
};
