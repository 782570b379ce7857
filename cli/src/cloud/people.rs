//! `gleaner users` and `gleaner audit`: the users of a cloud, and what they have changed.

use gleaner_base::{Exit, Failure, visible};
use gleaner_fleet::people::{AuditEntry, Invitation, NewUser, User};
use serde_json::json;

use super::{client, date, list, show};
use crate::account::CloudAccount;
use crate::args::{AuditArgs, UsersArgs, UsersCommand};
use crate::render::table;
use crate::vehicle::VehicleClient;

pub(super) fn users(args: &UsersArgs) -> Result<Exit, Failure> {
    let account = CloudAccount::load()?;
    let url = account.url.clone();
    let client = VehicleClient::of_cloud(account)?;
    match &args.command {
        None => show(args.json, &list::all::<User>(&client, "/v1/users", &[])?, |users| {
            let rows = users.iter().map(|user| [visible(&user.name), user.role.to_string()]);
            table(&["name", "role"], rows, &[])
        }),
        Some(UsersCommand::Invite(user)) => {
            let request = NewUser { name: user.name.clone(), role: user.role };
            let invitation: Invitation = client.create("/v1/users", &request)?;
            show(args.json, &invitation, |Invitation { user, code, expires }| {
                let (name, code) = (visible(&user.name), visible(code));
                format!(
                    "invited {name} ({}); until {}, once:\n  gleaner login {url} --code {code}\n",
                    user.role,
                    date(*expires)
                )
            })
        }
        Some(UsersCommand::Remove { name }) => {
            client.delete(&format!("/v1/users/{name}"))?;
            show(args.json, &json!({ "name": name, "removed": true }), |_| {
                format!("removed {name}\n")
            })
        }
    }
}

pub(super) fn audit(args: &AuditArgs) -> Result<Exit, Failure> {
    let entries: Vec<AuditEntry> = list::first(&client()?, "/v1/audit", &[], args.last)?;
    show(args.json, &entries, |entries| {
        let rows = entries.iter().map(|entry| {
            let time = date(entry.time_ms.div_euclid(1000).try_into().unwrap_or(0));
            let [actor, action, subject] =
                [&entry.actor, &entry.action, &entry.subject].map(|text| visible(text));
            [time, actor, action, subject]
        });
        table(&["time", "who", "action", "subject"], rows, &[])
    })
}
