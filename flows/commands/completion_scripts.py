"""The parts of completion scripts that no parser tells: how the words of a line become what may follow.

Each script holds a table of all commands and options, a program for awk that looks words up in it, and a
function that hands the words of its shell over and shows what comes back. awk is on every machine with a
shell, and starts in a few milliseconds; starting Python would take a second for each press of a key.

The table has one row a line, its fields with tabs in between:

* `C`, command: there is one of that name, such as `run` or `data check`.
* `O`, command, option, number, values: an option, behind which are `0`, `1` or `+` words with these values.
* `P`, command, values: words that are no options.
* `S`, command, prefix: the command takes all settings whose names begin so.
* `T`, setting, values: a setting.
* `Q`, name: a sequence of the catalogue.

Values are words with spaces in between, among them `@files`, `@sequences` and `@settings` (`NAME=VALUE`).
"""

from __future__ import annotations

__all__ = ["SCRIPTS"]

# It is inside single quotes in each of the shells: no single quote, and no backslash before another one.
AWK = r"""
BEGIN {
  FS = "\t"
  n = ARGC - 1
  for (i = 1; i <= n; i++) word[i] = ARGV[i]
  # What is left is standard input: the table.
  ARGC = 1
}
$1 == "C" {
  command[$2] = 1
  above = $2
  if (!sub(/ [^ ]*$/, "", above)) above = ""
  below[above] = below[above] " " substr($2, above == "" ? 1 : length(above) + 2)
}
$1 == "O" {
  options[$2] = options[$2] " " $3
  takes[$2, $3] = $4
  values[$2, $3] = $5
}
$1 == "P" { operands[$2] = $3 }
$1 == "S" { has_settings[$2] = 1; prefix[$2] = $3 }
$1 == "T" { setting[++settings] = $2; setting_values[$2] = $3 }
$1 == "Q" { sequence[++sequences] = $2 }

function propose(head, rest, text, steps,    at) {
  if (index(text, rest) != 1) return
  # Of long names the next part alone: all of them at once would be pages.
  if (steps && match(substr(text, length(rest) + 1), /[.\/]/)) text = substr(text, 1, length(rest) + RSTART)
  if (!((head text) in said)) print head text
  said[head text] = 1
}
function is_setting(path, option) {
  return (path in has_settings) && option ~ /^--/ && (substr(option, 3) in setting_values) &&
    index(substr(option, 3), prefix[path]) == 1
}
function number(path, option) {
  if ((path, option) in takes) return takes[path, option]
  return is_setting(path, option) ? "1" : "0"
}
function offer(path, list, head, rest,    count, item, i, k, at, name) {
  # Of several with commas in between the last is completed.
  while (list !~ /@/ && (at = index(rest, ","))) {
    head = head substr(rest, 1, at)
    rest = substr(rest, at + 1)
  }
  count = split(list, item, " ")
  for (i = 1; i <= count; i++) {
    if (item[i] == "@files") print "\t" head
    else if (item[i] == "@sequences") for (k = 1; k <= sequences; k++) propose(head, rest, sequence[k], 1)
    else if (item[i] == "@settings" && (at = index(rest, "="))) {
      name = substr(rest, 1, at - 1)
      if (name in setting_values) offer(path, setting_values[name], head name "=", substr(rest, at + 1))
    }
    else if (item[i] == "@settings") offer_settings(path, head, rest, "", "=")
    else if (item[i] !~ /^@/) propose(head, rest, item[i], 0)
  }
}
function offer_settings(path, head, rest, before, behind,    k) {
  if (path in has_settings) for (k = 1; k <= settings; k++) {
    if (index(setting[k], prefix[path]) == 1) propose(head, rest, before setting[k] behind, 1)
  }
}
function offer_value(path, option, head, rest) {
  if ((path, option) in takes) offer(path, values[path, option], head, rest)
  else if (is_setting(path, option)) offer(path, setting_values[substr(option, 3)], head, rest)
}
END {
  current = word[n]
  verb = 1
  for (i = 2; i < n && path in below; i++) {
    if (word[i] ~ /^-/) continue
    deeper = path == "" ? word[i] : path " " word[i]
    if (!(deeper in command)) exit
    path = deeper
    verb = i
  }
  if (match(current, /^--[^=]*=/)) {
    head = substr(current, 1, RLENGTH)
    offer_value(path, substr(head, 1, RLENGTH - 1), head, substr(current, RLENGTH + 1))
    exit
  }
  for (i = n - 1; i > verb; i--) {
    if (word[i] !~ /^-/) continue
    many = number(path, word[i])
    if ((many == "1" && i == n - 1) || (many == "+" && current !~ /^-/)) {
      offer_value(path, word[i], "", current)
      exit
    }
    break
  }
  if (current ~ /^-/) {
    offer(path, options[path], "", current)
    offer_settings(path, "", current, "--", "")
  }
  else if (path in below) offer(path, below[path], "", current)
  else offer(path, operands[path], "", current)
}
"""

BASH = r"""# bash completion of extrags, as `extrags completion bash` prints it.
_extrags_table='@TABLE@'

_extrags_completions() {
    printf '%s\n' "$_extrags_table" | awk '@AWK@' "$@"
}

# Words of the line as the command gets them, into `words`. Into `typed` what readline replaces, as it stands:
# it begins behind the last word break (of which `@` is replaced too), or behind a quote that is open, which
# is then in `quote`.
_extrags_split() {
    local i mark word="" begun=""
    words=() typed="" quote=""
    for (( i = 0; i < ${#1}; i++ )); do
        mark="${1:i:1}"
        if [[ $quote == *\\ ]]; then
            if [[ $quote == \"\\ && $mark != [\"\\\$\`] ]]; then word+=\\; fi
            word+="$mark" typed+="\\$mark" quote="${quote%\\}"
        elif [[ $mark == \\ && $quote != \' ]]; then
            begun=1 quote+=\\
        elif [[ -n $quote && $mark == "$quote" ]]; then
            typed="$before$quote$typed$quote" quote=""
        elif [[ -n $quote ]]; then
            word+="$mark" typed+="$mark"
        elif [[ $mark == [\"\'] ]]; then
            begun=1 before="$typed" typed="" quote="$mark"
        elif [[ $mark == [[:space:]] ]]; then
            if [[ -n $begun ]]; then words+=("$word"); fi
            word="" begun="" typed=""
        else
            begun=1 word+="$mark" typed+="$mark"
            if [[ $mark == [=:@] && $COMP_WORDBREAKS == *"$mark"* ]]; then typed="${mark#[=:]}"; fi
        fi
    done
    words+=("$word")
    quote="${quote%\\}"
}

# One more proposal: a whole word, of which the end that is not typed yet is quoted as its beginning is.
_extrags_add() {
    local current="${words[${#words[@]}-1]}" i end=""
    local more="${1:${#current}}"
    if [[ $1 != "$current"* ]]; then return; fi
    case $quote in
        \") for (( i = 0; i < ${#more}; i++ )); do
                if [[ ${more:i:1} == [\"\\\$\`] ]]; then end+=\\; fi
                end+="${more:i:1}"
            done ;;
        \') end="${more//\'/\'\\\'\'}" ;;
        *) if [[ -n $more ]]; then printf -v end %q "$more"; fi ;;
    esac
    COMPREPLY+=("$typed$end")
}

_extrags() {
    local current reply head file place tilde typed quote before
    local -a words
    COMPREPLY=()
    _extrags_split "${COMP_LINE:0:COMP_POINT}"
    current="${words[${#words[@]}-1]}"
    while IFS= read -r reply; do
        if [[ $reply == $'\t'* ]]; then
            head="${reply:1}"
            while IFS= read -r file; do
                # What is in a variable is not expanded by the shell: `~` and `~NAME` are no folders to -d.
                tilde="${file%%/*}" place="$file"
                if [[ $tilde =~ ^~[[:alnum:]_.-]*$ ]]; then
                    eval "place=$tilde"
                    place+="${file:${#tilde}}"
                fi
                if [[ -d $place && $file != */ ]]; then file+=/; fi
                _extrags_add "$head$file"
            done < <(compgen -f -- "${current:${#head}}")
            # readline closes no quote behind a folder then.
            if [[ -n $quote ]]; then compopt -o filenames -o noquote 2> /dev/null; fi
        else
            _extrags_add "$reply"
        fi
    done < <(_extrags_completions "${words[@]}")
    if [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *[./=] ]]; then
        compopt -o nospace 2> /dev/null
    fi
}

complete -F _extrags extrags
"""

ZSH = r"""#compdef extrags
# zsh completion of extrags, as `extrags completion zsh` prints it.
_extrags_table='@TABLE@'

_extrags_completions() {
    printf '%s\n' "$_extrags_table" | awk '@AWK@' "$@"
}

_extrags() {
    local reply head files=
    local -a unfinished finished
    while IFS= read -r reply; do
        if [[ $reply == $'\t'* ]]; then
            files=1 head="${reply#$'\t'}"
        elif [[ $reply == *[./=] ]]; then
            unfinished+=("$reply")
        else
            finished+=("$reply")
        fi
    done < <(_extrags_completions "${(@)words[1,CURRENT-1]}" "$PREFIX")
    compadd -S '' -a unfinished
    compadd -a finished
    if [[ -n $files ]]; then
        compset -p ${#head}
        _files
    fi
    # Whether anything was added, for who asks other functions otherwise.
    (( compstate[nmatches] ))
}

compdef _extrags extrags
if [[ $funcstack[1] == _extrags ]]; then _extrags "$@"; fi
"""

FISH = r"""# fish completion of extrags, as `extrags completion fish` prints it.
set -g __extrags_table '@TABLE@'

function __extrags_completions
    printf '%s\n' $__extrags_table | awk '@AWK@' $argv
end

function __extrags_complete
    set -l current (commandline -ct)
    for reply in (__extrags_completions (commandline -opc) "$current")
        if string match -q \t'*' -- $reply
            set -l head (string sub -s 2 -- $reply)
            set -l begun (string sub -s (math (string length -- "$head") + 1) -- "$current")
            for file in (__fish_complete_path "$begun")
                printf '%s\n' $head$file
            end
        else
            printf '%s\n' $reply
        end
    end
end

complete -c extrags -f -a '(__extrags_complete)'
"""

SCRIPTS = {
    shell: script.replace("@AWK@", AWK.strip())
    for shell, script in (("bash", BASH), ("zsh", ZSH), ("fish", FISH))
}
"""Scripts by shell; `@TABLE@` in them stands for the table."""
