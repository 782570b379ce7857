//! `gleaner login`, `logout` and `whoami`: the address of a cloud and the token for it.

use std::io::{BufRead, IsTerminal, Read, stdin};

use gleaner_base::{Exit, Failure, visible};
use gleaner_fleet::people::{Login, User, UserToken};
use serde_json::json;

use super::{date, show};
use crate::account::{CloudAccount, CloudUrl};
use crate::args::{ListArgs, LoginArgs};
use crate::output::print_error;
use crate::vehicle::VehicleClient;

pub(super) fn login(args: &LoginArgs) -> Result<Exit, Failure> {
    let url: CloudUrl = args.url.parse().map_err(|reason: String| {
        Failure::new(Exit::Usage, reason).with_help("the cloud shows its address when it starts")
    })?;
    if let Some(warning) = url.warning() {
        print_error(&format!("{warning}\n"));
    }
    let account = CloudAccount { url: url.clone(), token: String::new() };
    let login = Login { code: args.code.clone().map_or_else(read_code, Ok)? };
    let session: UserToken = VehicleClient::of_cloud(account)?.post("/v1/login", &login)?;
    let file = CloudAccount { url: url.clone(), token: session.token }.save()?;
    let (user, file, url) = (session.user, file.display().to_string(), url.to_string());
    // The token itself is not shown.
    let result = json!({ "user": user, "url": url, "file": file, "expires": session.expires });
    show(args.json, &result, |_| {
        let (name, until) = (visible(&user.name), date(session.expires));
        format!("logged in to {url} as {name} ({}; expires {until})\n", user.role)
    })
}

fn read_code() -> Result<String, Failure> {
    if stdin().is_terminal() {
        eprint!("code: ");
    }
    let mut line = String::new();
    // A code is far shorter.
    stdin().lock().take(1024).read_line(&mut line).map_err(|error| {
        Failure::caused_by(Exit::Usage, "cannot read a code from standard input", &error)
    })?;
    match line.trim() {
        "" => Err(Failure::new(Exit::Usage, "there is no code on standard input")
            .with_help("write the code of the invitation there, or name it with --code CODE")),
        code => Ok(code.to_owned()),
    }
}

pub(super) fn logout(args: &ListArgs) -> Result<Exit, Failure> {
    let ended = match CloudAccount::stored() {
        Ok(None) => Ok(()),
        Ok(Some(account)) => match VehicleClient::of_cloud(account)?.delete("/v1/login") {
            // The cloud did not know the token any more.
            Err(failure) if failure.exit == Exit::Denied => Ok(()),
            ended => ended,
        },
        // A file that cannot be used is removed, too.
        Err(failure) => Err(failure.with_help("`gleaner login` gets another token")),
    };
    let removed = CloudAccount::remove()?;
    if let Err(mut failure) = ended {
        let message = "removed the token here, but the cloud accepts it until it expires";
        failure.causes.insert(0, failure.message);
        failure.message = message.to_owned();
        return Err(failure);
    }
    show(args.json, &json!({ "removed": removed }), |_| {
        let text = match removed {
            true => "ended and removed the token\n",
            false => "there was no token\n",
        };
        text.to_owned()
    })
}

pub(super) fn whoami(args: &ListArgs) -> Result<Exit, Failure> {
    let account = CloudAccount::load()?;
    let url = account.url.clone();
    let user: User = VehicleClient::of_cloud(account)?.get("/v1/me")?;
    show(args.json, &user, |user| format!("{} ({}) at {url}\n", visible(&user.name), user.role))
}
