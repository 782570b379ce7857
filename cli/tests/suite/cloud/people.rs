//! `login`, `logout`, `whoami`, `users` and `audit`.

use std::fs;
use std::os::unix::fs::PermissionsExt;

use serde_json::{Value, json};

use super::CloudUser;
use super::fake::problem;
use crate::programs::{self, fails};

#[test]
fn a_login_stores_the_token_for_its_user_alone_until_the_logout() {
    let user = CloudUser::logged_in();
    let seen = user.cloud.seen();
    assert_eq!(seen[0].body, br#"{"code":"c0de"}"#);
    let file = user.path("config/gleaner/cloud.json");
    let mode = |path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!((mode(file.clone()), mode(user.path("config/gleaner"))), (0o600, 0o700));
    user.cloud.answers("GET /v1/me", &[(200, json!({ "name": "ada", "role": "admin" }))]);
    assert_eq!(user.done(&["whoami"]), format!("ada (admin) at {}\n", user.cloud.url()));
    assert_eq!(user.json(&["whoami"]), json!({ "name": "ada", "role": "admin" }));
    assert_eq!(user.cloud.seen()[0].authorization.as_deref(), Some("Bearer gln_1"));
    fs::set_permissions(&file, fs::Permissions::from_mode(0o644)).unwrap();
    let text = user.fails(3, &["whoami"]);
    assert!(text.contains("other users can read the token") && text.contains("chmod 600"));
    fs::set_permissions(&file, fs::Permissions::from_mode(0o600)).unwrap();
    user.cloud.answers("DELETE /v1/login", &[(204, json!(null))]);
    assert!(user.done(&["logout"]).starts_with("ended and removed the token"));
    assert!(!file.exists());
    assert_eq!(user.cloud.seen()[0].authorization.as_deref(), Some("Bearer gln_1"));
    assert_eq!(user.json(&["logout"]), json!({ "removed": false }));
    let text = user.fails(3, &["whoami"]);
    assert!(text.contains("not logged in to a cloud") && text.contains("`gleaner login URL"));
}

#[test]
fn a_logout_without_the_cloud_forgets_the_token_and_reports_that_it_has_not_ended() {
    let user = CloudUser::logged_in();
    user.cloud.answers("DELETE /v1/login", &[(500, problem(1, "the disk is full"))]);
    let text = user.fails(1, &["logout"]);
    assert!(text.contains("the cloud accepts it until it expires"), "{text}");
    assert!(text.contains("the disk is full"), "{text}");
    assert!(!user.path("config/gleaner/cloud.json").exists());
}

#[test]
fn a_logout_with_an_unusable_file_reports_that_the_token_has_not_ended() {
    let user = CloudUser::logged_in();
    let file = user.path("config/gleaner/cloud.json");
    fs::set_permissions(&file, fs::Permissions::from_mode(0o644)).unwrap();
    let text = user.fails(3, &["logout"]);
    assert!(text.contains("the cloud accepts it until it expires") && !file.exists(), "{text}");
}

#[test]
fn tokens_are_made_listed_and_removed() {
    let user = CloudUser::logged_in();
    let me = json!({ "name": "ada", "role": "viewer" });
    let made = json!({ "user": me, "token": "gln_2", "expires": 4102444800_u64 });
    user.cloud.answers("POST /v1/tokens", &[(200, made)]);
    user.cloud.seen();
    let text = user.done(&["tokens", "new", "nightly", "--role", "viewer", "--days", "7"]);
    assert!(text.contains("nightly (viewer; expires 2100-01-01T00:00:00Z)"), "{text}");
    assert!(text.ends_with("\n  gln_2\n"), "{text}");
    let sent = r#"{"name":"nightly","role":"viewer","days":7}"#;
    assert_eq!(user.cloud.seen()[0].body, sent.as_bytes());
    let listed = json!([{ "user": "ada", "name": "nightly", "role": "viewer", "expires": 0 }]);
    let page = json!({ "items": listed });
    user.cloud.answers("GET /v1/tokens", &[(200, page)]);
    assert_eq!(user.json(&["tokens"]), listed);
    assert!(user.done(&["tokens"]).contains("nightly"));
    user.cloud.answers("GET /v1/me", &[(200, me)]);
    user.cloud.answers("DELETE /v1/tokens/ada/nightly", &[(204, json!(null))]);
    assert_eq!(user.done(&["tokens", "remove", "nightly"]), "removed nightly\n");
    user.cloud.answers("DELETE /v1/tokens/bea/old", &[(204, json!(null))]);
    user.done(&["tokens", "remove", "old", "--user", "bea"]);
}

#[test]
fn a_refused_code_and_a_bad_address_leave_no_file() {
    let user = CloudUser::new();
    user.cloud.answers("POST /v1/login", &[(401, problem(3, "the code is not valid"))]);
    let text = user.fails(3, &["login", &user.cloud.url(), "--code", "x"]);
    assert!(text.contains("the code is not valid") && text.contains("a help"), "{text}");
    user.fails(2, &["login", "https://127.0.0.1:1", "--code", "x"]);
    user.fails(2, &["login", "127.0.0.1", "--code", "x"]);
    let text = user.fails(5, &["login", "http://127.0.0.1:1", "--code", "x"]);
    assert!(text.contains("cannot reach the cloud at http://127.0.0.1:1"), "{text}");
    assert!(!user.path("config").exists());
}

#[test]
fn a_code_can_come_from_standard_input_where_other_users_do_not_see_it() {
    let user = CloudUser::new();
    user.cloud.answers("POST /v1/login", &[(401, problem(3, "the code is not valid"))]);
    fs::write(user.path("code"), "c0de\n").unwrap();
    let mut login = user.command(&["login", &user.cloud.url()]);
    login.stdin(fs::File::open(user.path("code")).unwrap());
    fails(login, 3);
    assert_eq!(user.cloud.seen()[0].body, br#"{"code":"c0de"}"#);
    let text = user.fails(2, &["login", &user.cloud.url()]);
    assert!(text.contains("there is no code on standard input"), "{text}");
}

#[test]
fn the_environment_outweighs_the_file_and_no_token_reaches_another_cloud() {
    let user = CloudUser::logged_in();
    user.cloud.answers("GET /v1/me", &[(200, json!({ "name": "ci", "role": "deployer" }))]);
    user.cloud.seen();
    let mut whoami = user.command(&["whoami"]);
    programs::done(whoami.env("GLEANER_CLOUD_TOKEN", "gln_2"));
    assert_eq!(user.cloud.seen()[0].authorization.as_deref(), Some("Bearer gln_2"));
    let elsewhere = CloudUser::new();
    let mut whoami = user.command(&["whoami"]);
    whoami.env("GLEANER_CLOUD", elsewhere.cloud.url());
    let text = fails(whoami, 3);
    assert!(text.contains("there is no token for") && text.contains("GLEANER_CLOUD_TOKEN"));
    assert!(elsewhere.cloud.seen().is_empty());
    let mut whoami = elsewhere.command(&["whoami"]);
    whoami.env("GLEANER_CLOUD", user.cloud.url()).env("GLEANER_CLOUD_TOKEN", "gln_3");
    programs::done(&mut whoami);
    let mut whoami = user.command(&["whoami"]);
    whoami.env("GLEANER_CLOUD", "cloud.example");
    assert!(fails(whoami, 2).contains("cannot use GLEANER_CLOUD"));
}

#[test]
fn a_refused_token_is_an_error_that_names_the_login() {
    let user = CloudUser::logged_in();
    user.cloud.answers("GET /v1/vehicles", &[(401, problem(3, "the token has expired"))]);
    let text = user.fails(3, &["vehicles"]);
    assert!(text.contains("the token has expired") && text.contains("`gleaner login URL"));
    user.cloud.answers("GET /v1/users", &[(403, problem(3, "`ada` is no admin"))]);
    let text = user.fails(3, &["users"]);
    assert!(text.contains("`ada` is no admin") && text.contains("help:  a help"), "{text}");
}

#[test]
fn users_are_listed_invited_and_removed() {
    let user = CloudUser::logged_in();
    let users = json!([{ "name": "ada", "role": "admin" }, { "name": "bob", "role": "viewer" }]);
    user.cloud.answers("GET /v1/users", &[(200, json!({ "items": users }))]);
    assert_eq!(user.done(&["users"]), "name  role\nada   admin\nbob   viewer\n");
    assert_eq!(user.json(&["users"]), users);
    let invitation = json!({
        "user": { "name": "bob", "role": "viewer" }, "code": "c0de", "expires": 4102444800_u64,
    });
    user.cloud.answers("POST /v1/users", &[(200, invitation.clone())]);
    user.cloud.seen();
    let text = user.done(&["users", "invite", "bob", "--role", "viewer"]);
    assert!(text.ends_with(&format!("gleaner login {} --code c0de\n", user.cloud.url())), "{text}");
    assert_eq!(user.cloud.seen()[0].body, br#"{"name":"bob","role":"viewer"}"#);
    assert_eq!(user.json(&["users", "invite", "bob", "--role", "viewer"]), invitation);
    user.cloud.answers("DELETE /v1/users/bob", &[(204, json!(null))]);
    assert_eq!(user.done(&["users", "remove", "bob"]), "removed bob\n");
    for bad in [&["users", "remove", "../x"][..], &["users", "invite", "bob", "--role", "root"]] {
        assert_eq!(programs::output(&mut user.command(bad)).status.code(), Some(2));
    }
}

#[test]
fn the_audit_trail_shows_the_newest_entries() {
    let user = CloudUser::logged_in();
    let entry = |seq: u64| {
        json!({
            "seq": seq, "time_ms": 1_533_198_891_500_i64, "actor": "ada", "action": "deploy",
            "subject": format!("brake-{seq}"), "hash": "h",
        })
    };
    user.cloud.answers("GET /v1/audit?limit=1", &[(200, json!({ "items": [entry(2), entry(1)] }))]);
    let text = user.done(&["audit", "-n", "1"]);
    assert!(text.ends_with("2018-08-02T08:34:51Z  ada  deploy  brake-2\n"), "{text}");
    assert_eq!(user.json(&["audit", "--last", "1"]), json!([entry(2)]));
}

#[test]
fn a_list_is_followed_to_its_end_and_one_without_an_end_is_refused() {
    let user = CloudUser::logged_in();
    let some = |names: std::ops::Range<usize>| -> Value {
        names.map(|it| json!({ "name": format!("u{it}"), "role": "viewer" })).collect()
    };
    let page = |names, next: &str| (200, json!({ "items": some(names), "next": next }));
    let last = (200, json!({ "items": some(500..501) }));
    user.cloud.answers("GET /v1/users", &[page(0..500, "a&b")]);
    user.cloud.answers("GET /v1/users?after=a%26b", &[last]);
    assert_eq!(user.json(&["users"]), some(0..501));
    user.cloud.answers("GET /v1/users?after=a%26b", &[page(0..500, "a&b")]);
    user.cloud.answers("GET /v1/users?limit=1&after=a%26b", &[page(0..1, "a&b")]);
    let text = user.fails(1, &["users"]);
    assert!(text.contains("more than 100000 entries"), "{text}");
    // Parts without entries would be requested for ever.
    user.cloud.answers("GET /v1/users?after=a%26b", &[page(0..0, "a&b")]);
    let text = user.fails(1, &["users"]);
    assert!(text.contains("the list `/v1/users` does not end"), "{text}");
    user.cloud.answers("GET /v1/clips?label=x", &[page(0..0, "1")]);
    let text = user.fails(1, &["clips", "export", "--label", "x", "--to", "out"]);
    assert!(text.contains("the list `/v1/clips` does not end"), "{text}");
}

#[test]
fn each_clip_is_removed_that_can_be_and_those_that_stay_are_named() {
    let user = CloudUser::logged_in();
    let remove = ["clips", "remove", "a@car-7", "b@car-7", "c@car-7", "d@car-7"];
    let answers = [
        ("a", 403, problem(3, "`ada` is no deployer")),
        ("b", 204, json!(null)),
        ("c", 404, problem(2, "there is no clip `c@car-7`")),
        ("d", 204, json!(null)),
    ];
    for (name, status, answer) in answers {
        user.cloud.answers(&format!("DELETE /v1/clips/{name}@car-7"), &[(status, answer)]);
    }
    let output = programs::output(&mut user.command(&remove));
    assert_eq!(output.status.code(), Some(3), "the worst one");
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(text, "removed b@car-7\nremoved d@car-7\n");
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(errors.contains("2 of 4 clips stay in the cloud"), "{errors}");
    assert!(errors.contains("`a@car-7`: `ada` is no deployer"), "{errors}");
    assert!(errors.contains("`c@car-7`: there is no clip `c@car-7`"), "{errors}");
    let text = user.fails(2, &["clips", "remove", "c@car-7"]);
    assert!(text.contains("there is no clip `c@car-7`") && !text.contains("of 1"), "{text}");
}
