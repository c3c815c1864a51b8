// The live page: its files, which are part of the program, with what a browser needs to trust and
// to keep them.
#include <stdio.h>
#include <string.h>
#include <xxhash.h>

#include "server/routes_inside.h"
#include "server/scenes_data.h"

// Nothing but what this server gives out, no code in the document itself, no text taken for HTML.
#define POLICY                                                                                     \
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src "        \
    "'self'; "                                                                                     \
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; require-trusted-types-for "      \
    "'script'"

bool routes_is_page(const char *path) {
    return strcmp(path, "/") == 0 ||
           (strncmp(path, "/page/", 6) == 0 && strchr(path + 6, '/') == NULL);
}

static const char *type_of(const char *name) {
    static const struct {
        const char *ending, *type;
    } types[] = {{".html", "text/html; charset=utf-8"},
                 {".css", "text/css; charset=utf-8"},
                 {".js", "text/javascript; charset=utf-8"},
                 {".svg", "image/svg+xml"}};
    const char *ending = strrchr(name, '.');
    for (size_t k = 0; ending != NULL && k < sizeof types / sizeof *types; k++)
        if (strcmp(ending, types[k].ending) == 0)
            return types[k].type;
    return "application/octet-stream";
}

void routes_serve_page(struct call *c) {
    const char *name = c->names[0][0] != '\0' ? c->names[0] : "page.html";
    const struct embedded *file = page_data;
    while (file->name != NULL && strcmp(file->name, name) != 0)
        file++;
    if (file->name == NULL) {
        reply_problem(c->reply, 404, NULL, "the page has no file %.80s", name);
        return;
    }
    char tag[24];
    const char *known = http_header(c->request, "If-None-Match");
    snprintf(tag, sizeof tag, "\"%016llx\"",
             (unsigned long long)XXH3_64bits(file->text, file->bytes));
    bool same = known != NULL && strstr(known, tag) != NULL;
    c->reply->status = same ? 304 : 200;
    c->reply->type = same ? NULL : type_of(file->name);
    c->reply->constant = file->text;
    c->reply->bytes = same ? 0 : file->bytes;
    c->reply->cache = "no-cache"; // kept, and asked for again: another build has another page
    http_reply_header(c->reply, "ETag", "%s", tag);
    http_reply_header(c->reply, "Content-Security-Policy", "%s", POLICY);
    http_reply_header(c->reply, "Referrer-Policy", "no-referrer");
    http_reply_header(c->reply, "Cross-Origin-Opener-Policy", "same-origin");
    http_reply_header(c->reply, "Cross-Origin-Resource-Policy", "same-origin");
}
