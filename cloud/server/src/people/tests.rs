use axum::body::Body;
use gleaner_fleet::people::{NewToken, NewUser};
use hyper::service::Service;
use hyper_util::service::TowerToHyperService;
use tempfile::TempDir;
use tokio::sync::Semaphore;

use super::*;
use crate::attempts::{VehicleLimits, WrongSecrets};
use crate::authority::Authorities;
use crate::clips::ClipFiles;
use crate::folder::DataFolder;
use crate::hub::Hub;
use crate::objects::Objects;
use crate::place::FilePlace;
use crate::store::{ClipBounds, CloudStore, Retention};

pub(crate) const ROLES: [Role; 4] = [Role::Viewer, Role::Operator, Role::Deployer, Role::Admin];

pub(crate) async fn cloud(folder: &TempDir) -> Arc<Cloud> {
    let data = DataFolder::create(&folder.path().join("data")).unwrap();
    let clips = FilePlace::open(data.clips(), None, "").unwrap();
    Arc::new(Cloud {
        store: CloudStore::of_test(folder).await,
        objects: Objects::new(FilePlace::open(data.objects(), None, "").unwrap()),
        clips: Arc::new(ClipFiles::new(clips, ClipBounds::DEFAULT)),
        hub: Hub::default(),
        authorities: Authorities::open(&data).unwrap(),
        wrong_secrets: WrongSecrets::default(),
        limits: VehicleLimits::default(),
        readers: Arc::default(),
        stored_frames: Semaphore::new(4),
        retention: Retention::DEFAULT,
        address: "127.0.0.1:8443".to_owned(),
    })
}

/// Sends a request with a token; returns the status of the answer.
async fn status_of(
    cloud: &Arc<Cloud>,
    method: Method,
    path: &str,
    token: Option<&str>,
) -> StatusCode {
    request(cloud, method, path, token, "{}".to_owned()).await
}

/// Sends a request with a token and a body; returns the status of the answer.
async fn request(
    cloud: &Arc<Cloud>,
    method: Method,
    path: &str,
    token: Option<&str>,
    body: String,
) -> StatusCode {
    let slots = Arc::new(Semaphore::new(1));
    let peer = PeerConnection::of_test([127, 0, 0, 1].into(), slots.try_acquire_owned().unwrap());
    let mut request = Request::builder().method(method).uri(path).extension(Arc::new(peer));
    if let Some(token) = token {
        request = request.header(header::AUTHORIZATION, format!("Bearer {token}"));
    }
    let router = TowerToHyperService::new(router(cloud));
    let reply = router.call(request.body(Body::from(body)).unwrap()).await;
    reply.unwrap().status()
}

#[tokio::test]
async fn each_request_is_open_to_its_role_and_the_higher_ones_only() {
    let folder = TempDir::new().unwrap();
    let cloud = cloud(&folder).await;
    let mut tokens = Vec::new();
    for role in ROLES {
        let new = NewUser { name: role.to_string(), role };
        let code = cloud.store.invite("console", new).await.unwrap().code;
        let session = cloud.store.login(&code).await.unwrap().unwrap();
        tokens.push((role, session.token));
    }
    assert!(endpoints().len() > 15);
    for Endpoint { method, path, role, .. } in endpoints() {
        // Things that do not exist: a request that is let through changes nothing.
        let path = path.replace("{name}", "no-such").replace("{id}", "no-such");
        let path = path.replace("{user}", "no-such");
        // It ends the token of each, which has a test of its own.
        if (&method, &*path) == (&Method::DELETE, "/v1/login") {
            continue;
        }
        let path = path.replace("{change}", "start").replace("{sha256}", &"0".repeat(64));
        let status = status_of(&cloud, method.clone(), &path, None).await;
        let expected =
            if role.is_none() { StatusCode::BAD_REQUEST } else { StatusCode::UNAUTHORIZED };
        assert_eq!(status, expected, "{method} {path} without a token");
        for (has, token) in &tokens {
            let status = status_of(&cloud, method.clone(), &path, Some(token)).await;
            let is_let = role.is_none_or(|role| *has >= role);
            assert_eq!(
                status != StatusCode::FORBIDDEN,
                is_let,
                "{method} {path} as {has}: {status}"
            );
            assert_ne!(status, StatusCode::UNAUTHORIZED, "{method} {path} as {has}");
            assert!(!status.is_server_error(), "{method} {path} as {has}: {status}");
        }
    }
}

#[tokio::test]
async fn a_token_for_programs_has_at_most_the_rights_of_its_user_and_makes_no_others() {
    let folder = TempDir::new().unwrap();
    let cloud = cloud(&folder).await;
    let invite = async |role| {
        let new = NewUser { name: "ann".to_owned(), role };
        cloud.store.invite("console", new).await.unwrap().code
    };
    let login = cloud.store.login(&invite(Role::Deployer).await).await.unwrap().unwrap();
    let make = async |name: &str, role, days| {
        let new = NewToken { name: name.to_owned(), role, days };
        cloud.store.make_token(&login.user, new).await
    };
    let made = make("nightly", Role::Operator, 30).await.unwrap();
    let reason = |made: CloudResult<UserToken>| made.unwrap_err().reason();
    assert!(reason(make("nightly", Role::Viewer, 1).await).contains("a token `nightly` already"));
    assert!(reason(make("a", Role::Admin, 1).await).contains("has the role deployer, not admin"));
    assert!(reason(make("a/b", Role::Viewer, 1).await).contains("cannot be the name"));
    for days in [0, 367, u32::MAX] {
        assert!(reason(make("a", Role::Viewer, days).await).contains("cannot be valid"));
    }
    let status =
        async |method, path, token: &str| status_of(&cloud, method, path, Some(token)).await;
    let token = &*made.token;
    assert_eq!(status(Method::GET, "/v1/vehicles", token).await, StatusCode::OK);
    assert_eq!(status(Method::POST, "/v1/deployments", token).await, StatusCode::FORBIDDEN);
    let new = NewToken { name: "child".to_owned(), role: Role::Viewer, days: 1 };
    let body = serde_json::to_string(&new).unwrap();
    let sent = request(&cloud, Method::POST, "/v1/tokens", Some(token), body.clone()).await;
    assert_eq!(sent, StatusCode::FORBIDDEN);
    let sent = request(&cloud, Method::POST, "/v1/tokens", Some(&login.token), body).await;
    assert_eq!(sent, StatusCode::OK);
    // A user who has fewer rights from now on has them with each token.
    invite(Role::Viewer).await;
    assert_eq!(status(Method::POST, "/v1/deployments/x/start", token).await, StatusCode::FORBIDDEN);
    // Nobody else than an administrator can remove it, or learn that it exists.
    let code =
        cloud.store.invite("console", NewUser { name: "bea".to_owned(), role: Role::Viewer });
    let bea = cloud.store.login(&code.await.unwrap().code).await.unwrap().unwrap().token;
    let path = "/v1/tokens/ann/nightly";
    assert_eq!(status(Method::DELETE, path, &bea).await, StatusCode::NOT_FOUND);
    assert_eq!(cloud.store.tokens(Some("bea")).await.unwrap(), []);
    let all: Vec<_> = cloud.store.tokens(None).await.unwrap();
    assert_eq!(all.iter().map(|it| &*it.name).collect::<Vec<_>>(), ["child", "nightly"]);
    assert_eq!(status(Method::DELETE, path, &login.token).await, StatusCode::NO_CONTENT);
    assert_eq!(status(Method::GET, "/v1/me", token).await, StatusCode::UNAUTHORIZED);
    // A logout ends the token in the cloud, too.
    assert_eq!(status(Method::DELETE, "/v1/login", &bea).await, StatusCode::NO_CONTENT);
    assert_eq!(status(Method::GET, "/v1/me", &bea).await, StatusCode::UNAUTHORIZED);
}

#[tokio::test]
async fn wrong_tokens_are_limited_and_the_user_is_removed_with_the_token() {
    let folder = TempDir::new().unwrap();
    let cloud = cloud(&folder).await;
    let new = NewUser { name: "ann".to_owned(), role: Role::Viewer };
    let code = cloud.store.invite("console", new).await.unwrap().code;
    let token = cloud.store.login(&code).await.unwrap().unwrap().token;
    let me = async |token| status_of(&cloud, Method::GET, "/v1/me", Some(token)).await;
    assert_eq!(me(&token).await, StatusCode::OK);
    cloud.store.remove_user("console", "ann").await.unwrap();
    for _ in 0..10 {
        assert_eq!(me(&token).await, StatusCode::UNAUTHORIZED);
    }
    assert_eq!(me(&token).await, StatusCode::TOO_MANY_REQUESTS);
    // Others at the address are not refused.
    let new = NewUser { name: "bea".to_owned(), role: Role::Viewer };
    let code = cloud.store.invite("console", new).await.unwrap().code;
    let other = cloud.store.login(&code).await.unwrap().unwrap().token;
    assert_eq!(me(&other).await, StatusCode::OK);
}
