// fbar, the command-line client of fbard: what is asked for, and to whom it goes.
#include <malloc.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/commands.h"
#include "client/complete.h"
#include "client/help.h"
#include "client/interrupt.h"
#include "client/report.h"
#include "client/request.h"
#include "client/terminal.h"

static int print_version(bool json) {
    puts(json ? "{\"version\": \"" FBARD_VERSION "\"}" : "fbar " FBARD_VERSION);
    return CLIENT_DONE;
}

// With --json there is an answer in any case: what went wrong, where nothing else was printed.
static void print_faults(int code) {
    cJSON *answer = cJSON_CreateObject();
    cJSON_AddNumberToObject(answer, "exit_code", code);
    cJSON *list = cJSON_AddArrayToObject(answer, "faults");
    for (int i = 0; terminal_fault(i); i++)
        cJSON_AddItemToArray(list, cJSON_CreateString(terminal_fault(i)));
    report_json(answer);
    cJSON_Delete(answer);
}

// Of a command line that could not be read to its end.
static bool wants_json(int argc, char **argv) {
    for (int i = 1; i < argc; i++)
        if (strcmp(argv[i], "--json") == 0)
            return true;
    return false;
}

static const char *first_of(const char *a, const char *b) {
    return a ? a : b;
}

static int run_command(const struct command *command, const struct arguments *global,
                       const struct arguments *arguments) {
    char url[1024];
    const char *environment = getenv("FBAR_URL");
    const char *given = first_of(arguments_value(arguments, "url"), arguments_value(global, "url"));
    if (!given && environment && *environment)
        given = environment;
    snprintf(url, sizeof url, "%s", first_of(given, CLIENT_DEFAULT_URL));
    for (size_t n = strlen(url); n > 0 && url[n - 1] == '/'; n--)
        url[n - 1] = '\0';
    if (strncmp(url, "http://", 7) != 0 && strncmp(url, "https://", 8) != 0) {
        terminal_error("--url: must begin with http:// or https://, got \"%s\"", url);
        return CLIENT_USAGE;
    }
    struct client client = {
        .url = url,
        .url_given = given != NULL,
        .token_file = first_of(arguments_value(arguments, "token-file"),
                               arguments_value(global, "token-file")),
        .curve_file = first_of(arguments_value(arguments, "curve-file"),
                               arguments_value(global, "curve-file")),
        .json = arguments_flag(arguments, "json") || arguments_flag(global, "json"),
    };
    client.requests = request_create(client.url, client.token_file);
    if (!client.requests)
        return CLIENT_IO;
    const int code = command->run(&client, arguments);
    request_free(client.requests);
    if (client.json && code != CLIENT_DONE && !report_printed())
        print_faults(code);
    if (fflush(stdout) != 0 || ferror(stdout)) {
        terminal_error("cannot write to standard output");
        return CLIENT_IO;
    }
    return code;
}

int main(int argc, char **argv) {
    static struct arguments global, arguments; // large
    signal(SIGPIPE, SIG_IGN);
    signal(SIGXFSZ, SIG_IGN); // a file over the limit is an error like a full disk
    // Frames come and go by the megabyte: their memory is kept instead of being mapped, and cleared
    // page by page, for each.
    mallopt(M_MMAP_THRESHOLD, 32 << 20);
    mallopt(M_TRIM_THRESHOLD, 128 << 20);
    interrupt_catch();
    if (argc > 1 && strcmp(argv[1], "__complete") == 0) // asked by the shells' scripts
        return complete_print(argc - 2, argv + 2);
    if (argc > 1 && strcmp(argv[1], "__manual") == 0) { // asked by the Makefile
        help_print_manual();
        return CLIENT_DONE;
    }
    const int used = arguments_parse(argc - 1, argv + 1, NULL, &global);
    if (used < 0)
        return CLIENT_USAGE;
    argc -= used + 1;
    argv += used + 1;
    const bool json = arguments_flag(&global, "json");
    if (arguments_flag(&global, "version") || (argc > 0 && strcmp(argv[0], "version") == 0))
        return print_version(json);
    if (argc == 0 || strcmp(argv[0], "help") == 0) {
        const struct command *command = argc > 1 ? commands_expect(argv[1]) : NULL;
        if (argc > 1 && !command)
            return CLIENT_USAGE;
        if (command)
            help_print_command(command);
        else
            help_print();
        return argc > 0 || arguments_flag(&global, "help") ? CLIENT_DONE : CLIENT_USAGE;
    }
    const struct command *command = commands_expect(argv[0]);
    if (!command || arguments_parse(argc - 1, argv + 1, command, &arguments) < 0) {
        if (json || (command && wants_json(argc, argv)))
            print_faults(CLIENT_USAGE);
        return CLIENT_USAGE;
    }
    if (arguments_flag(&arguments, "version"))
        return print_version(json || arguments_flag(&arguments, "json"));
    if (arguments_flag(&arguments, "help") || arguments_flag(&global, "help")) {
        help_print_command(command);
        return CLIENT_DONE;
    }
    return run_command(command, &global, &arguments);
}
