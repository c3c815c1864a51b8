// fbar completion: scripts for shells, which ask `fbar __complete` (complete.c) what fits.
#include <cjson/cJSON.h>
#include <stdio.h>
#include <string.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/report.h"
#include "client/terminal.h"

static const char bash[] =
    "# bash completion of fbar, from `fbar completion bash`\n"
    "_fbar() {\n"
    "    local IFS=$'\\n' line word=${COMP_WORDS[COMP_CWORD]}\n"
    "    COMPREPLY=()\n"
    "    while IFS= read -r line; do\n"
    "        case $line in\n"
    "        :folders) COMPREPLY+=($(compgen -d -- \"$word\")); compopt -o filenames ;;\n"
    "        :files) COMPREPLY+=($(compgen -f -- \"$word\")); compopt -o filenames ;;\n"
    "        :files*) COMPREPLY+=($(compgen -d -- \"$word\"; compgen -f -X \"!${line#:files }\" -- "
    "\"$word\"))\n"
    "            compopt -o filenames ;;\n"
    "        *) line=${line%%$'\\t'*}\n"
    "            [[ $line == *= ]] && compopt -o nospace\n"
    "            COMPREPLY+=(\"$line\") ;;\n"
    "        esac\n"
    "    done < <(\"$1\" __complete \"${COMP_WORDS[@]:1:COMP_CWORD}\" 2>/dev/null)\n"
    "}\n"
    "complete -F _fbar fbar\n";

static const char zsh[] =
    "#compdef fbar\n"
    "# zsh completion of fbar, from `fbar completion zsh`\n"
    "_fbar() {\n"
    "    local line word\n"
    "    local -a words_ keys_\n"
    "    while IFS= read -r line; do\n"
    "        case $line in\n"
    "        :folders) _files -/ ;;\n"
    "        :files) _files ;;\n"
    "        :files*) _files -g \"${line#:files }\" ;;\n"
    "        *=) keys_+=(\"${line//:/\\\\:}\") ;;\n"
    "        *) word=${line%%$'\\t'*}; word=${word//:/\\\\:}\n"
    "            [[ $line == *$'\\t'* ]] && word+=:${line#*$'\\t'}\n"
    "            words_+=(\"$word\") ;;\n"
    "        esac\n"
    "    done < <(\"${words[1]}\" __complete \"${(@)words[2,CURRENT]}\" 2>/dev/null)\n"
    "    (( $#words_ )) && _describe -t fbar fbar words_\n"
    "    (( $#keys_ )) && _describe -t keys key keys_ -S ''\n"
    "    return 0\n"
    "}\n"
    "if [[ ${funcstack[1]} = _fbar ]]; then _fbar \"$@\"; else compdef _fbar fbar; fi\n";

static int run(struct client *client, const struct arguments *arguments) {
    const char *shell = arguments->positionals[0];
    const char *script = strcmp(shell, "bash") == 0 ? bash : strcmp(shell, "zsh") == 0 ? zsh : NULL;
    if (!script) {
        terminal_error("%s: must be bash or zsh", shell);
        return CLIENT_USAGE;
    }
    if (!client->json) {
        fputs(script, stdout);
        return CLIENT_DONE;
    }
    cJSON *answer = cJSON_CreateObject();
    cJSON_AddStringToObject(answer, "shell", shell);
    cJSON_AddStringToObject(answer, "script", script);
    report_json(answer);
    cJSON_Delete(answer);
    return CLIENT_DONE;
}

const struct command cmd_completion = {
    .name = "completion",
    .positionals = "SHELL",
    .summary = "print the completion script for bash or zsh",
    .doc = "`make install` puts them into place. Commands, options, files, names of scenes, and the\n"
           "runs and keys that the daemon knows are completed.",
    .examples = "source <(fbar completion bash)\n"
                "fbar completion zsh > ~/.zfunc/_fbar",
    .least = 1,
    .most = 1,
    .run = run,
};
