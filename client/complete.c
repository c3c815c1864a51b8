// What a place wants is read from the tables of commands and options: from the word that stands for
// it in the help.
#include "client/complete.h"

#include <cjson/cJSON.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/commands.h"
#include "client/daemon.h"
#include "client/request.h"
#include "client/store.h"
#include "client/terminal.h"

#define ANSWER_MS 1000 // nobody waits longer for a completion

struct place {
    const char *typed;             // so far
    const struct command *command; // NULL: the command itself is typed
    const char *of;                // its first word: a run, a scene or a file
    const char *url, *token_file;
};

static void offer(const struct place *p, const char *word, const char *about) {
    if (strncmp(word, p->typed, strlen(p->typed)) == 0)
        printf("%s%s%s\n", word, about && *about ? "\t" : "", about ? about : "");
}

// NULL where there is no answer. What every daemon knows is asked of a private one where there is
// no other (a quarter of a second).
static cJSON *ask(const struct place *p, const char *path, bool any_daemon) {
    struct client client = {.url = p->url ? p->url : CLIENT_DEFAULT_URL,
                            .url_given = p->url || !any_daemon,
                            .token_file = p->token_file};
    struct client asked;
    struct daemon daemon;
    struct reply reply;
    char why[256];
    cJSON *answer = NULL;
    client.requests = request_create(client.url, client.token_file);
    const struct request_spec spec = {
        .method = "GET", .path = path, .accept = "application/json", .timeout_ms = ANSWER_MS};
    if (client.requests && daemon_reach(&client, &daemon, &asked) == CLIENT_DONE) {
        if (request_send(asked.requests, &spec, &reply, why, sizeof why) == 0) {
            answer = reply.status == 200 ? cJSON_Parse(reply.body) : NULL;
            request_reply_free(&reply);
        }
        daemon_leave(&daemon, &asked);
    }
    request_free(client.requests);
    return answer;
}

static const char *text(const cJSON *object, const char *key) {
    const char *value = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(object, key));
    return value ? value : "";
}

static void offer_listed(const struct place *p, const char *path, const char *list,
                         const char *name, const char *about) {
    cJSON *answer = ask(p, path, strcmp(list, "scenes") == 0);
    const cJSON *item;
    cJSON_ArrayForEach(item, cJSON_GetObjectItemCaseSensitive(answer, list))
        offer(p, text(item, name), text(item, about));
    cJSON_Delete(answer);
}

// The keys of a configuration or a scene, dotted, each with "=".
static void offer_keys(const struct place *p, const cJSON *object, const char *before) {
    const cJSON *item;
    cJSON_ArrayForEach(item, object) {
        char *key = NULL;
        if (!item->string || asprintf(&key, "%s%s%s", before, *before ? "." : "", item->string) < 0)
            continue;
        if (cJSON_IsObject(item) && item->child) {
            offer_keys(p, item, key);
        } else {
            char *word = NULL;
            if (asprintf(&word, "%s=", key) >= 0)
                offer(p, word, NULL);
            free(word);
        }
        free(key);
    }
}

static void offer_settings(const struct place *p) {
    const bool run = strcmp(p->command->name, "set") == 0;
    if (!p->of || strchr(p->typed, '='))
        return;
    char *path = run ? request_path("/v1/runs/", p->of, "/config")
                     : request_path("/v1/scenes/", p->of, "");
    cJSON *answer = path ? ask(p, path, !run) : NULL;
    offer_keys(p, answer, "");
    cJSON_Delete(answer);
    free(path);
}

static void offer_fields(const struct place *p) {
    char why[512];
    bool foreign;
    struct store_file *h5 = p->of ? store_open(p->of, &foreign, why, sizeof why) : NULL;
    if (!h5)
        return;
    const struct store_contents *c = store_contents(h5);
    for (size_t i = 0; i < c->n_arrays; i++)
        offer(p, c->arrays[i].name, c->arrays[i].long_name);
    store_close(h5);
}

static void offer_commands(const struct place *p) {
    for (const struct commands_group *g = commands_groups; g->title; g++)
        for (const struct command *const *c = g->commands; *c; c++)
            offer(p, (*c)->name, (*c)->summary);
    offer(p, "help", "tell more about a command");
}

static void offer_options(const struct place *p, const struct option_spec *options) {
    for (; options && options->name; options++) {
        char word[64];
        snprintf(word, sizeof word, "--%s", options->name);
        offer(p, word, options->doc);
    }
}

// `wanted` is the word that stands for the place in the help, of `n` bytes.
static void offer_place(const struct place *p, const char *wanted, size_t n) {
    const char *name = p->command ? p->command->name : "";
    char word[64];
    snprintf(word, sizeof word, "%.*s", (int)n, wanted);
    if (strcmp(word, "RUN") == 0)
        offer_listed(p, "/v1/runs", "runs", "id", "state");
    else if (strcmp(word, "SCENE") == 0 || (strcmp(word, "NAME") == 0 && !strcmp(name, "scenes")))
        offer_listed(p, "/v1/scenes", "scenes", "name", "title");
    else if (strcmp(word, "NAME") == 0 && strcmp(name, "plot") == 0)
        offer_fields(p);
    else if (strcmp(word, "KEY=VALUE") == 0)
        offer_settings(p);
    else if (strcmp(word, "COMMAND") == 0)
        offer_commands(p);
    else if (strcmp(word, "DIR") == 0)
        puts(":folders");
    else if (strncmp(word, "FILE.", 5) == 0)
        printf(":files *.%s\n", word + 5);
    else if (strncmp(word, "FILE", 4) == 0)
        puts(":files");
    if (strcmp(word, "SCENE") == 0)
        puts(":files *.json");
    if (strcmp(word, "SHELL") == 0) {
        offer(p, "bash", NULL);
        offer(p, "zsh", NULL);
    }
}

// The word for positional k in "RUN KEY=VALUE...", "RUN [N]", "FILE.h5... -o FILE.png".
static void offer_positional(const struct place *p, int k) {
    const char *at = p->command->positionals, *last = NULL;
    size_t last_n = 0;
    bool repeats = false;
    while (*at) {
        at += strspn(at, " [");
        size_t n = strcspn(at, " ]");
        const char *word = at;
        at += n;
        at += strspn(at, " ]");
        if (word[0] == '-') { // an option, with its value
            at += strcspn(at, " ");
            continue;
        }
        repeats = n > 3 && strncmp(word + n - 3, "...", 3) == 0;
        n -= repeats ? 3 : 0;
        last = word;
        last_n = n;
        if (k-- == 0)
            break;
    }
    if (last && (k < 0 || repeats))
        offer_place(p, last, last_n);
}

static const struct option_spec *option_of(const struct command *command, const char *word) {
    const struct option_spec *lists[] = {command ? command->options : NULL, arguments_global};
    for (int i = 0; i < 2; i++)
        for (const struct option_spec *o = lists[i]; o && o->name; o++)
            if ((strncmp(word, "--", 2) == 0 && strcmp(word + 2, o->name) == 0) ||
                (word[0] == '-' && o->letter && word[1] == o->letter && !word[2]))
                return o;
    return NULL;
}

int complete_print(int n, char **words) {
    struct place p = {.typed = n > 0 ? words[n - 1] : "", .url = getenv("FBAR_URL")};
    const struct option_spec *pending = NULL; // the option whose value comes next
    int k = 0;                                // positionals of the command so far
    terminal_mute();
    if (p.url && !*p.url)
        p.url = NULL;
    for (int i = 0; i + 1 < n; i++) {
        const char *word = words[i];
        if (pending) {
            p.url = strcmp(pending->name, "url") == 0 ? word : p.url;
            p.token_file = strcmp(pending->name, "token-file") == 0 ? word : p.token_file;
            pending = NULL;
        } else if (word[0] == '-' && word[1]) {
            const struct option_spec *option = option_of(p.command, word);
            pending = option && option->value ? option : NULL;
        } else if (!p.command && strcmp(word, "help") == 0) {
            offer_commands(&p);
            return CLIENT_DONE;
        } else if (!p.command) {
            p.command = commands_find(word);
            if (!p.command)
                return CLIENT_DONE;
        } else if (k++ == 0) {
            p.of = word;
        }
    }
    if (pending) {
        offer_place(&p, pending->value, strlen(pending->value));
    } else if (p.typed[0] == '-') {
        offer_options(&p, p.command ? p.command->options : NULL);
        offer_options(&p, arguments_global);
    } else if (!p.command) {
        offer_commands(&p);
    } else {
        offer_positional(&p, k);
    }
    return CLIENT_DONE;
}
