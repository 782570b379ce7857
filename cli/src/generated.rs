//! Generates shell completions and man pages from the definition of the command line.

use std::path::Path;

use clap::CommandFactory;
use clap_complete::Shell;
use gleaner_base::{Exit, Failure};

use crate::args::Cli;
use crate::output::print;

pub(crate) fn completions(shell: Shell) -> Result<Exit, Failure> {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut Cli::command(), "gleaner", &mut script);
    print(&String::from_utf8_lossy(&script))?;
    Ok(Exit::Ok)
}

pub(crate) fn man(folder: &Path) -> Result<Exit, Failure> {
    let written = std::fs::create_dir_all(folder)
        .and_then(|()| clap_mangen::generate_to(Cli::command(), folder));
    written.map_err(|error| {
        let failure = Failure::caused_by(
            Exit::Usage,
            format!("cannot write man pages into `{}`", folder.display()),
            &error,
        );
        failure.with_help("name a writable folder, such as ~/.local/share/man/man1")
    })?;
    print(&format!(
        "wrote the man pages into {}; read them with: man -l {}\n",
        folder.display(),
        folder.join("gleaner.1").display()
    ))?;
    Ok(Exit::Ok)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_has_a_man_page() {
        let folder = tempfile::tempdir().unwrap();
        man(folder.path()).unwrap();
        let names = Cli::command()
            .get_subcommands()
            .map(|command| command.get_name().to_owned())
            .collect::<Vec<_>>();
        assert!(names.len() > 10, "{names:?}");
        for name in names {
            let page =
                std::fs::read_to_string(folder.path().join(format!("gleaner-{name}.1"))).unwrap();
            assert!(page.contains(".SH SYNOPSIS"), "{name}");
        }
    }

    #[test]
    fn completions_have_commands_and_flags() {
        for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), "gleaner", &mut script);
            let script = String::from_utf8(script).unwrap();
            assert!(
                ["replay", "no-record", "disk-floor"].iter().all(|word| script.contains(word)),
                "{shell}"
            );
        }
    }
}
