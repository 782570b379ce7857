//! The command line of the program.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use gleaner_base::{Exit, Failure, sync_folder};
use gleaner_fleet::people::{NewUser, Role};
use gleaner_protocol::process_stats::log;
use rustix::fs::Mode;
use rustix::process::umask;
use tokio::signal::unix::{SignalKind, signal};

use crate::folder::DataFolder;
use crate::server::{CloudServer, ServeOptions};
use crate::store::{CONSOLE, CloudStore};

/// The cloud of a fleet: vehicles connect to it, and people deploy by it.
#[derive(Parser, Debug)]
#[command(name = "gleaner-cloud", version = gleaner_base::version())]
struct Args {
    #[command(subcommand)]
    command: CloudCommand,
}

#[derive(Subcommand, Debug)]
enum CloudCommand {
    /// Serve people and vehicles until SIGTERM
    Serve(ServeOptions),
    /// Print a one-time code for a user; a server may run meanwhile
    Invite {
        /// Name of the user
        name: String,
        /// Role of the user: viewer, operator, deployer or admin
        #[arg(long, value_name = "ROLE")]
        role: Role,
        /// Folder of the server
        #[arg(long, value_name = "DIR")]
        data: PathBuf,
        /// Database of a PostgreSQL server, as postgres://USER@HOST/DATABASE, with the password in
        /// PGPASSWORD [default: a file in the folder]
        #[arg(long, value_name = "URL")]
        store: Option<String>,
    },
    /// Write a copy of the database; a server may run meanwhile
    Backup {
        /// File to write, which must not exist
        file: PathBuf,
        /// Folder of the server
        #[arg(long, value_name = "DIR")]
        data: PathBuf,
    },
}

pub fn main() -> ExitCode {
    log::init_service();
    // Each connection takes one; the usual limit is low.
    gleaner_base::raise_open_files();
    // The database and its copies are for this user only, wherever they are.
    umask(Mode::RWXG | Mode::RWXO);
    let args = Args::parse();
    match run(args.command) {
        Ok(()) => Exit::Ok.into(),
        Err(failure) => {
            log::failure(&failure);
            failure.exit.into()
        }
    }
}

fn run(command: CloudCommand) -> Result<(), Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot start threads", &error))?;
    let done = runtime.block_on(async {
        match command {
            CloudCommand::Serve(options) => serve(options).await,
            CloudCommand::Invite { name, role, data, store } => {
                invite(NewUser { name, role }, &data, store.as_deref()).await
            }
            CloudCommand::Backup { file, data } => backup(&file, &data).await,
        }
    });
    runtime.shutdown_background();
    done
}

async fn serve(options: ServeOptions) -> Result<(), Failure> {
    let failed =
        |error| Failure::caused_by(Exit::Internal, "cannot handle SIGTERM and SIGINT", &error);
    let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
    let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
    let mut server = CloudServer::start(&options).await?;
    let address = format!("http://{}", server.people);
    let mut text = format!("people:   {address}\nvehicles: {}\n", server.vehicles);
    if let Some(code) = &server.code {
        text += &format!("first:    gleaner login {address} --code {code}\n");
    }
    text += &format!("page:     {address}/login\n");
    print(&text);
    let failed = tokio::select! {
        _ = terminate.recv() => None,
        _ = interrupt.recv() => None,
        failure = server.failed() => Some(failure),
    };
    server.stop().await;
    failed.map_or(Ok(()), Err)
}

async fn invite(new: NewUser, data: &Path, store: Option<&str>) -> Result<(), Failure> {
    let store = CloudStore::in_use(&DataFolder::existing(data)?.store(store)?).await?;
    let invitation = store.invite(CONSOLE, new).await?;
    store.close().await;
    print(&format!("{}\n", invitation.code));
    Ok(())
}

async fn backup(file: &Path, data: &Path) -> Result<(), Failure> {
    let refused = |reason: &str, help: &str| {
        let message = format!("`{}` {reason}", file.display());
        Failure::new(Exit::Usage, message).with_help(help)
    };
    let failed = |error: io::Error| {
        Failure::caused_by(Exit::Usage, format!("cannot write `{}`", file.display()), &error)
    };
    if file.symlink_metadata().is_ok() {
        return Err(refused("exists already", "choose another file, or remove it first"));
    }
    // A name that began with `file:` would be a URL to SQLite.
    let whole = std::path::absolute(file).map_err(failed)?;
    let folder = whole.parent().unwrap_or(&whole);
    let store = CloudStore::in_use(&DataFolder::existing(data)?.store(None)?).await?;
    // Another backup to the same file has another one.
    let part = tempfile::Builder::new().prefix(".backup-").suffix(".part").tempfile_in(folder);
    let part = part.map_err(failed)?;
    let name = part.path().to_str();
    let name = name.ok_or_else(|| refused("is not UTF-8", "choose another name"))?;
    store.copy_to(name).await?;
    store.close().await;
    let made = part.as_file().sync_all().map_err(failed);
    let copy = made.and_then(|()| part.persist_noclobber(&whole).map_err(|it| failed(it.error)))?;
    sync_folder(folder).map_err(failed)?;
    let bytes = copy.metadata().map_err(failed)?.len();
    print(&format!("`{}` has {bytes} bytes\n", whole.display()));
    Ok(())
}

fn print(text: &str) {
    let mut out = std::io::stdout();
    // A starter that does not read must not keep the server from serving.
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn former_names_of_options_still_work() {
        for names in [["--http", "--insecure-http"], ["--people", "--insecure-people"]] {
            let args = ["gleaner-cloud", "serve", "--data", "d", names[0], "0.0.0.0:1", names[1]];
            let CloudCommand::Serve(it) = Args::parse_from(args).command else { panic!() };
            assert_eq!((it.people, it.is_insecure), (([0, 0, 0, 0], 1).into(), true), "{names:?}");
        }
    }
}
